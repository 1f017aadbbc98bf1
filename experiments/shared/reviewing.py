"""`review` of `experiments.real`: list, confirm, discard and check trajectories, and draw images of trajectories.

The trajectories are in a work directory.
"""

import dataclasses
from pathlib import Path

import cv2
from PIL import Image, ImageDraw, ImageFont

from experiments.shared import drawing
from experiments.shared.run import Folder
from experiments.shared.terminal import say
from sts_jax import hardware

SHEET = 20  # number of trajectories, the newest ones, that `--sheet` draws by default
PANEL = 200  # width of an image on the sheet (pixels)


@dataclasses.dataclass(frozen=True)
class Review:
    """List, discard, restore or confirm trajectories, check their files, or draw their images."""

    workdir: Folder = Path("runs/real")  # work directory. The trajectories are in its folder `dataset`
    discard: tuple[int, ...] = ()  # numbers of trajectories to move to the folder `discarded`
    restore: tuple[int, ...] = ()  # numbers of discarded trajectories to move back
    # numbers of trajectories to confirm. They have both pairs of images, but the session was interrupted before they
    # were confirmed
    confirm: tuple[int, ...] = ()
    note: str = ""  # text that is stored with the trajectories of --confirm
    check: bool = False  # read all images, and compare their checksums
    sheet: Path | None = None  # draw the newest confirmed trajectories into this picture
    numbers: tuple[int, ...] = ()  # numbers of trajectories that --sheet draws instead
    debug: bool = False  # show the traceback of every error


def review(config: Review) -> None:
    """Confirm, discard or restore trajectories, check files, draw images, or list trajectories, as the options select.

    Raises:
        SystemExit: `check` is True, and a file is damaged.
        ValueError: A trajectory cannot be drawn, or `sheet` does not have the suffix of a picture file.
        OSError: A trajectory does not exist, or a file cannot be read or written.
    """
    folder = config.workdir / "dataset"
    if config.sheet is not None:
        drawing.check_picture(config.sheet)
    for number in config.restore:
        hardware.restore_recording(folder, number)
    for number in config.confirm:
        hardware.confirm_recording(folder, number, config.note)
    for number in config.discard:
        hardware.discard_recording(folder, number)
    if config.check:
        check(folder)
    if config.sheet is not None:
        draw(folder, config.numbers, config.sheet)
        print(config.sheet)
    if config.check or config.sheet is not None:
        return
    entries = hardware.list_recordings(folder)
    for entry in entries:
        print(f"{entry.number:5d}  {entry.standing:11s}  {entry.taken or '-':29s}  {entry.note}".rstrip())
    print(f"{sum(entry.standing == 'confirmed' for entry in entries)} confirmed of {len(entries)} in {folder}")


def check(folder: Path) -> None:
    """Read all confirmed trajectories, and report the damaged ones.

    Raises:
        SystemExit: A trajectory is damaged.
    """
    recordings, damaged = hardware.load_recordings(folder), 0
    for index in range(len(recordings)):
        try:
            recordings[index]
        except OSError as error:
            say(str(error))
            damaged += 1
    print(f"{len(recordings) - damaged} of {len(recordings)} confirmed trajectories are undamaged in {folder}")
    if damaged:
        raise SystemExit(1)


def draw(folder: Path, numbers: tuple[int, ...], path: Path) -> None:
    """Draw trajectories as rows of four images: initial visual and tactile, final visual and tactile.

    Args:
        folder: Folder `dataset` of a work directory, which contains the trajectories.
        numbers: Numbers of the trajectories. If empty, the newest `SHEET` trajectories are drawn.
        path: Path of the picture.

    Raises:
        ValueError: A number belongs to no confirmed trajectory, or `folder` has no confirmed trajectory.
    """
    recordings = hardware.load_recordings(folder)
    if unknown := set(numbers) - set(recordings.numbers):
        raise ValueError(
            f"{folder} has no confirmed trajectories with the numbers {sorted(unknown)}: give other --numbers"
        )
    if not recordings.numbers:
        raise ValueError(f"no picture can be drawn, because {folder} has no confirmed trajectory: collect some first")
    chosen = numbers or recordings.numbers[-SHEET:]
    rows = []
    for number in chosen:
        trajectory = recordings[recordings.numbers.index(number)]
        shots = [shot for pair in (trajectory.initial, trajectory.final) for shot in (pair.visual, pair.tactile)]
        height = round(PANEL * shots[0].image.shape[0] / shots[0].image.shape[1])
        rows.append([cv2.resize(shot.image, (PANEL, height), interpolation=cv2.INTER_AREA) for shot in shots])
    height, margin, head = rows[0][0].shape[0], 60, 24
    sheet = Image.new("RGB", (margin + 4 * (PANEL + 4), head + len(rows) * (height + 4)), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=14)
    for column, title in enumerate(("initial, visual", "initial, tactile", "final, visual", "final, tactile")):
        pen.text((margin + column * (PANEL + 4), 4), title, fill="black", font=font)
    for row, (number, images) in enumerate(zip(chosen, rows, strict=True)):
        pen.text((6, head + row * (height + 4) + height // 2 - 8), str(number), fill="black", font=font)
        for column, image in enumerate(images):
            sheet.paste(Image.fromarray(image), (margin + column * (PANEL + 4), head + row * (height + 4)))
    drawing.write_picture(path, sheet)
