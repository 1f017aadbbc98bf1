"""The browser page of `experiments.live`, with the live images and the predicted images."""

import time
from pathlib import Path
from typing import Any

from experiments.shared.live import Seen
from experiments.shared.site import Image, Site

_PAGE = Path(__file__).with_name("live_page.html")
_STREAMS = ("visual", "tactile", "predicted_visual", "predicted_tactile")


class LivePage(Site):
    """The browser page of `experiments.live`, which shows the live images, the predicted images and other values."""

    def __init__(self, host: str, port: int, *, title: str):
        """Start the server of the page.

        Args:
            host: Address or name on which the server listens, such as 127.0.0.1.
            port: TCP port. 0 selects a free one.
            title: Text that names the source and the model.

        Raises:
            OSError: The address cannot be used. The message names the address and the remedy.
        """
        self._title = title
        self._seen: Seen | None = None
        super().__init__(host, port, _PAGE, _STREAMS)

    def show(self, seen: Seen) -> None:
        """Update the images and the other values, such as the latency, in all open pages."""
        with self._changed:
            self._seen, self._number = seen, self._number + 1
            self._changed.notify_all()

    def facts(self) -> dict[str, Any]:
        """The values that the page shows besides the images, such as the latency, as a dict for JSON."""
        with self._changed:
            seen, ended = self._seen, self._ended
        if seen is None:
            return {"title": self._title, "waiting": True, "ended": ended}
        found = seen.predicted
        return {
            "title": self._title,
            "waiting": found is None,
            "ended": ended,
            "note": seen.note,
            "age_s": time.monotonic() - seen.time_s,
            "images_per_s": seen.images_per_s,
            "recorded": seen.recorded,
            "rate": seen.rate,
            "latency_ms": None if seen.latency_s is None else 1000 * seen.latency_s,
            "contact": None if found is None else found.contact,
            "occupied": None if found is None else found.occupied,
            "outcomes": [] if found is None else found.outcomes,
        }

    def image(self, stream: str) -> Image | None:
        """The newest image of a stream such as `visual` or `predicted_visual`, or None before the first image."""
        with self._changed:
            seen = self._seen
        if seen is None:
            return None
        if stream.startswith("predicted_"):
            return None if seen.predicted is None else getattr(seen.predicted, stream.removeprefix("predicted_"))
        return getattr(seen, stream)
