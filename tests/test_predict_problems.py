"""Warnings about inputs that are valid and probably wrong, and predictions in two threads."""

import os
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from statespace_config import state_model

import sts_jax as sts
from sts_jax._plausible import image_problem, order_problem, pair_problem, pose_problem

SIZE = 64
SENSOR = sts.Sensor()
RNG = np.random.default_rng(0)
AWAY = np.array([0, 0, -1, 1, 0, 0, 0], np.float32)
rendered = jax.jit(lambda body, pose, wrench: sts.sense(SENSOR, body, pose, wrench, resolution=(SIZE, SIZE)))


def cube(folder, side, colour):
    mesh = trimesh.creation.box((side,) * 3)
    mesh.visual.vertex_colors = [*colour, 255]
    mesh.export(folder / "cube.ply")
    return sts.objects.load(folder / "cube.ply")


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Frames of valid objects by name, and the frame of the empty sensor."""
    folder, key = tmp_path_factory.mktemp("cubes"), jax.random.key(0)
    bodies = {name: sts.objects.make(key, name) for name in ("bottle", "scissors", "watch")}
    for side in (0.00501, 0.02, 0.1499):
        for name, colour in (("black", (0, 0, 0)), ("white", (255, 255, 255)), ("pink", (204, 178, 178))):
            bodies[f"{name} cube of {side}"] = cube(folder, side, colour)
    frames = {}
    for name, body in bodies.items():
        for x, y in ((0.0, 0.0), (0.02, -0.03), (0.07, 0.03)):
            frames[name, x, y] = rendered(body, *sts.physics.place(body, SENSOR, position=(x, y)))
        pose, wrench = sts.physics.place(body, SENSOR, position=(0.01, 0.02))
        frames[name, "above"] = rendered(body, pose + jnp.eye(7)[2] * 0.05, 0 * wrench)
    empty = rendered(body, AWAY, jnp.zeros(6))
    return frames, empty


def rounded(image):
    """An image after it was a file of 8 bits."""
    return (np.round(255 * np.asarray(image)) / 255).astype(np.float32)


@pytest.mark.slow
def test_valid_images_have_no_problem(images):
    frames, empty = images
    for name, frame in frames.items():
        for stream in ("visual", "tactile"):
            image, blank = (rounded(getattr(x, stream)) for x in (frame, empty))
            assert image_problem(stream, image, blank) is None, (name, stream)
            if stream == "tactile" or frame.segmentation.sum() > 20:
                noisy = np.clip(image + RNG.normal(0, 0.006, image.shape), 0, 1).astype(np.float32)
                assert image_problem(stream, noisy, blank) is None, (name, stream)
        problem = pose_problem(rounded(frame.visual), rounded(empty.visual), np.asarray(frame.pose), 0.1, 0.15)
        assert problem is None, name


FAULTS = {
    "BGR": lambda image, blank: image[..., ::-1],
    "is black": lambda image, blank: 0 * image,
    "is black: ": lambda image, blank: np.abs(RNG.normal(0, 0.01, image.shape)),
    "is noise": lambda image, blank: RNG.random(image.shape),
    "is noise: ": lambda image, blank: image + RNG.normal(0, 0.1, image.shape),
    "no object in view": lambda image, blank: blank,
    "no object in view: ": lambda image, blank: blank + RNG.normal(0, 0.01, image.shape),
    "does not look like this sensor": lambda image, blank: np.broadcast_to(np.float32([0.9, 0.6, 0.3]), image.shape),
    "this sensor: ": lambda image, blank: np.meshgrid(*2 * [np.linspace(0, 1, SIZE)], [0.2, 0.5, 0.9])[0],
    "of another sensor": lambda image, blank: np.where(abs(image - blank) < 0.08, np.float32([0.1, 0.6, 0.2]), image),
}


@pytest.mark.parametrize("problem", FAULTS)
@pytest.mark.parametrize("name", [("bottle", 0.02, -0.03), ("scissors", 0.0, 0.0), ("black cube of 0.02", "above")])
def test_each_fault_of_an_image_is_found(images, problem, name):
    frames, empty = images
    for stream in ("visual",) if "object" in problem else ("visual", "tactile"):
        image, blank = (rounded(getattr(x, stream)) for x in (frames[name], empty))
        if stream == "tactile" and "another" in problem:
            continue  # nothing may press
        wrong = np.clip(FAULTS[problem](image, blank), 0, 1).astype(np.float32)
        found = image_problem(stream, wrong, blank)
        assert found is not None, stream
        assert found.startswith(stream)
        assert problem.strip(": ") in found


@pytest.mark.parametrize(
    ("turned", "problem"),
    [
        (lambda x: x[:, ::-1], "left and right"),
        (lambda x: x[::-1], "top and bottom"),
        (lambda x: np.rot90(x, 2), "upside down"),
        (lambda x: np.rot90(x), r"np.rot90(image, -1)"),
        (lambda x: np.rot90(x, -1), r"np.rot90(image)"),
        (lambda x: np.swapaxes(x, 0, 1), "np.swapaxes(image, 0, 1)"),
    ],
)
def test_a_turned_image_is_found_if_the_empty_sensor_has_a_bright_and_a_dark_side(turned, problem):
    across, down = np.meshgrid(np.linspace(0, 1, SIZE), np.linspace(0, 1, SIZE))
    blank = np.stack([0.3 + 0.2 * across, 0.3 + 0.3 * down, 0.4 + 0.2 * across * down], -1).astype(np.float32)
    image = blank.copy()
    image[20:30, 10:30] = 0.9
    noisy = np.clip(image + RNG.normal(0, 0.006, image.shape), 0, 1).astype(np.float32)
    for valid in (image, noisy):
        assert image_problem("visual", valid, blank) is None
        assert problem in image_problem("visual", np.ascontiguousarray(turned(valid)), blank)


def test_the_pose_of_another_image_is_found(images):
    frames, empty = images
    blank, found, far = rounded(empty.visual), 0, 0
    for name, frame in frames.items():
        for other in frames.values():
            places = [x.pose[:2] * 0.1 / (0.1 + x.pose[2]) for x in (frame, other)]
            if np.linalg.norm(places[0] - places[1]) > 0.04 and "0.1499" not in name[0]:
                far += 1
                found += pose_problem(rounded(frame.visual), blank, np.asarray(other.pose), 0.1, 0.15) is not None
    assert far > 20
    assert found > 0.8 * far
    for scale in (100, 1000):  # centimetres, millimetres
        pose = np.array([0.02 * scale, -0.03 * scale, 0.05 * scale, 1, 0, 0, 0])
        assert pose_problem(rounded(frames["bottle", 0.0, 0.0].visual), blank, pose, 1e3, 0.15) is not None


@pytest.mark.parametrize("turn", [lambda x: x[:, ::-1], lambda x: x[::-1], lambda x: np.rot90(x, 2)])
def test_a_contact_beside_the_object_is_found(images, turn):
    frames, empty = images
    blank = {stream: rounded(getattr(empty, stream)) for stream in ("visual", "tactile")}
    for (name, *place), frame in frames.items():
        visual, tactile = rounded(frame.visual), rounded(frame.tactile)
        assert pair_problem(visual, tactile, blank) is None, (name, place)
        if place == [0.07, 0.03] and name in ("bottle", "black cube of 0.02"):
            assert "none mirrored" in pair_problem(visual, turn(tactile), blank)


def test_the_order_of_many_quaternions_is_found():
    quats = RNG.normal(size=(200, 4))
    quats *= np.where(quats[:, :1] < 0, -1, 1) / np.linalg.norm(quats, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, 200) / 2
    turning = np.stack([np.cos(angle), 0 * angle, 0 * angle, np.sin(angle)], 1)
    assert "x, y, z, w" in order_problem(quats[:, [1, 2, 3, 0]])
    for valid in (quats, -quats, quats * RNG.choice([-1, 1], (200, 1)), turning, turning[:5], quats[:0]):
        assert order_problem(valid) is None


@pytest.fixture(scope="module")
def predictor():
    """A state-space model without training whose empty sensor is grey with a blue tint."""
    blank = np.full((32, 32, 3), (150, 160, 200), np.uint8)
    model = state_model()
    return sts.Predictor(model.model, model.preprocessing, (blank, blank), "tinted")


def seen(predictor, *places):
    """Visual images with a dark square at places (m)."""
    images = np.stack([predictor.empty["visual"]] * len(places))
    for image, place in zip(images, places, strict=True):
        column, row = (int(32 * (0.5 + x / predictor.model.config.view)) for x in place)
        image[row - 2 : row + 2, column - 2 : column + 2] = 0.2
    return images


def problems(call):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call()
    return [str(warning.message) for warning in caught], [warning.filename for warning in caught]


@pytest.mark.slow
def test_a_predictor_warns_once_of_each_problem_of_values_that_are_used_and_not_traced(predictor):
    images = seen(predictor, (0.02, 0.03), (-0.02, 0.0), (0.0, 0.0))
    poses = np.array([[0.02, 0.03, 0, 1, 0, 0, 0], [-0.02, 0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0]], np.float32)
    condition = {"condition": np.zeros((3, predictor.model.config.condition), np.float32)}
    assert problems(lambda: predictor(visual=images, pose=poses, **condition)) == ([], [])
    wrong = images.copy()
    wrong[:2], wrong[2] = images[:2, ..., ::-1], 0
    texts, files = problems(lambda: predictor(visual=wrong, pose=poses, **condition))
    assert len(texts) == 2
    assert "BGR" in texts[0]
    assert "black" in texts[1]
    assert set(files) == {__file__}
    (text,), _ = problems(lambda: predictor(visual=images, pose=poses[[1, 0, 2]], **condition))
    assert "order w, x, y, z" in text
    masked = {"visual": np.array([False, False, False])}
    assert problems(lambda: predictor(visual=wrong, pose=poses, present=masked, **condition))[0] == []
    assert problems(lambda: jax.jit(lambda x: predictor(visual=x, **condition))(wrong))[0] == []


def test_an_image_that_is_cropped_to_the_object_is_compared_by_its_colours():
    blank = np.full((SIZE, SIZE, 3), (150, 160, 200), np.float32) / 255
    image = np.full((SIZE, SIZE, 3), (90, 20, 20), np.float32) / 255  # the object fills the window
    assert image_problem("visual", image, blank, crop=True) is None
    image[: SIZE // 4] = blank[: SIZE // 4]
    assert image_problem("visual", image, blank, crop=True) is None
    assert "BGR" in image_problem("visual", image[..., ::-1], blank, crop=True)


THREADS = """
import sys, threading, jax, numpy as np, sts_jax as sts
count, rounds = map(int, sys.argv[1:])
predict = sts.Predictor.load("freefall")
rng = np.random.default_rng(0)
images = np.repeat(predict.empty["visual"][None], count, 0)
for image in images:
    row, column = rng.integers(20, 90, 2)
    image[row : row + 20, column : column + 20] = rng.random(3)
want = np.asarray(predict(visual=images).pose)
def work():
    for _ in range(rounds):
        np.testing.assert_allclose(predict(visual=images).pose, want, atol=1e-5)
    done.append(True)
done, threads = [], [threading.Thread(target=work) for _ in range(2)]
for thread in threads: thread.start()
for thread in threads: thread.join()
print(len(done))
"""


@pytest.mark.parametrize(
    ("count", "rounds"),
    [pytest.param(4, 3, marks=pytest.mark.slow, id="4"), pytest.param(60, 5, marks=pytest.mark.long, id="60")],
)
def test_two_threads_predict_at_the_same_time(count, rounds):
    """With an eigenvalue decomposition of LAPACK in the program, both threads waited for ever."""
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", THREADS, str(count), str(rounds)],
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert run.stdout == "2\n", run.stderr
