"""Try the sensor without hardware: hold an object, see how it is predicted to come to rest, and let it fall.

    python -m experiments.demo

The command starts a digital twin of the sensor, the model `freefall`, and a web page, which it opens in the browser if
this computer has a display. Choose one of the eight classes of objects on the page and press Hold. The page shows both
streams live, four samples of the images predicted at rest, and the outlines of the object at their poses. Press Release
to see what happens. Only this computer can open the page. Ctrl-C ends everything.

The first start compiles for about two minutes. Later ones take half a minute.
"""

import contextlib
import dataclasses
import os
import sys
import tempfile
import webbrowser
from pathlib import Path

import tyro

import sts_jax as sts
from experiments.shared import interrupts, terminal
from experiments.shared.device import TwinConfig, own_twin
from experiments.shared.live import Live, Views, follow
from experiments.shared.page import DemoPage
from experiments.shared.terminal import say
from sts_jax import hardware

MODEL = "freefall"
NOTE = (
    "The object is held 5 cm above the pad. The model was trained on simulated falls of other objects of these eight "
    "classes, and predicts from the visual image alone."
)
DWELL = 3  # number of successive images of one stream before the lights switch


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the command line."""

    browser: bool = True  # open the page in the browser if this computer has a display
    port: int = 8767  # TCP port of the page. 0 selects a free one
    debug: bool = False  # show the traceback of every error


def main(config: Config) -> None:
    """Start the page, the twin and the model, and predict until Ctrl-C."""
    with terminal.on_one_line(debug=config.debug), interrupts.in_order(), contextlib.ExitStack() as stack:
        sts.enable_compilation_cache()
        title = f"a digital twin of the sensor. Model: {MODEL}"
        page = DemoPage("127.0.0.1", config.port, title=title, note=NOTE, classes=sts.objects.CATEGORIES)
        stack.callback(page.close)
        if config.browser and (sys.platform == "darwin" or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()):
            webbrowser.open(page.url)
        page.tell(
            "starting a digital twin. The first start compiles for about two minutes, later ones take half a minute"
        )
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        twin = TwinConfig(object_class=sts.objects.CATEGORIES[0], scenario="freefall")
        leds, page.hand = stack.enter_context(own_twin(folder, twin))
        page.tell("loading the model. Its first start compiles for about half a minute")
        predictor, views = sts.Predictor.load(MODEL), Views.load(folder, divided=True)
        live = stack.enter_context(Live(predictor, views, ()))
        page.tell("connecting the sensor")
        sensor = stack.enter_context(hardware.STS.from_file(folder, leds=leds))
        try:
            for seen in follow(live, sensor.stream(dwell=DWELL), page.hand):
                page.show(seen)
        except KeyboardInterrupt:
            say("stopped")
        say(live.summary)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
