"""Figures of `show`, and files of `save` read with Pillow and NumPy."""

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from damage import damaged
from optics_bodies import noise
from PIL import Image

import sts_jax as sts
from sts_jax.storage import DamagedFileError

FRAME = noise((4, 6))
PREDICTION = sts.Prediction(FRAME.visual, FRAME.tactile, None, jnp.zeros(2), jnp.zeros(2))
BODY = sts.objects.make(jax.random.key(0), "bottle")


def same(left, right):
    assert type(left) is type(right)
    assert jax.tree.structure(left) == jax.tree.structure(right)
    for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_a_png_holds_both_streams_side_by_side(tmp_path):
    sts.save(tmp_path / "frame.PNG", FRAME)
    with Image.open(tmp_path / "frame.PNG") as picture:
        got = np.asarray(picture) / 255
    np.testing.assert_allclose(got, np.concatenate([FRAME.visual, FRAME.tactile], 1), atol=0.51 / 255)


HIDDEN = sts.physics.Hidden(jnp.array([0.5]), jnp.array([1.0]), jnp.array([0.6]), jnp.array([[0.0, 0, 1]]))
FLOATS = {"time": (1, 2), "pose": (1, 2, 7), "velocity": (1, 2, 6), "wrench": (1, 2, 6), "gravity": (1, 2, 3)}
FLOATS |= {"sunk": (1,), "condition": (1, 0)}
TRAJECTORY = sts.physics.Trajectory(
    **{name: jnp.full(shape, float(k)) for k, (name, shape) in enumerate(FLOATS.items())},
    **{name: jnp.ones((1, 2), bool) for name in ("contact", "wall")},
    **{name: jnp.full(1, k) for k, name in enumerate(("outcome", "touches", "body", "resampled"))},
    settled=jnp.array([True]),
    hidden=HIDDEN,
)


SHEARED = dataclasses.replace(FRAME, shear=jnp.ones((5, 5, 2)))


@pytest.mark.parametrize(
    "thing", [FRAME, SHEARED, BODY, TRAJECTORY], ids=["frame", "sheared frame", "body", "trajectory"]
)
def test_a_loaded_npz_equals_the_saved_object(tmp_path, thing):
    sts.save(tmp_path / "thing.npz", thing)
    same(sts.load(tmp_path / "thing.npz"), thing)


@pytest.mark.parametrize(
    ("thing", "name", "change", "message"),
    [
        (FRAME, "visual", lambda x: x[1:], "array tactile is float32 of shape"),
        (FRAME, "tactile", lambda x: x * np.nan, "array tactile has values that are not finite"),
        (SHEARED, "shear", lambda x: x[..., :1], "array shear is"),
        (FRAME, "segmentation", lambda x: x + 0.5, "array segmentation is float64"),
        (BODY, "hulls", lambda x: x + np.inf, "array hulls has values"),
        (BODY, "faces", lambda x: x + 10**6, "faces has indices from"),
        (TRAJECTORY, "hidden/fill", lambda x: np.zeros(2), "array hidden/fill .* must be Float of shape"),
        (TRAJECTORY, "time", lambda x: np.zeros((1, 3)), "array pose is"),
        (TRAJECTORY, "sunk", lambda x: np.array([np.nan]), "array sunk has"),
    ],
)
def test_arrays_of_wrong_shapes_types_and_values_are_named(tmp_path, thing, name, change, message):
    path = tmp_path / "a.npz"
    sts.save(path, thing)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **(arrays | {name: change(arrays[name])}))
    with pytest.raises(DamagedFileError, match=rf"a\.npz is damaged .*{message}"):
        sts.load(path)


def test_what_cannot_be_loaded_is_not_saved(tmp_path):
    with pytest.raises(ValueError, match="array hulls has values that are not finite"):
        sts.save(tmp_path / "a.npz", dataclasses.replace(BODY, hulls=BODY.hulls * jnp.nan))
    unbalanced = dataclasses.replace(FRAME, pose=FRAME.pose * jnp.nan, balanced=jnp.array(False))
    sts.save(tmp_path / "a.npz", unbalanced)  # as `sense` returns it for an invalid pose
    same(sts.load(tmp_path / "a.npz"), unbalanced)


def test_a_damaged_file_raises_an_error_unless_the_damage_is_outside_the_arrays(tmp_path):
    path, refused = tmp_path / "frame.npz", 0
    sts.save(path, FRAME)
    for damage in damaged(path, flips=60):
        try:
            same(sts.load(path), FRAME)
        except DamagedFileError:
            refused += 1
        except FileNotFoundError:
            assert damage == "missing"
    assert refused > 20


def test_a_file_of_another_format_raises_an_error(tmp_path):
    np.savez(tmp_path / "x.npz", kind=np.array("Frame"), format=np.array(99))
    with pytest.raises(DamagedFileError, match=r"x\.npz is damaged or was not written by this version.*format 99"):
        sts.load(tmp_path / "x.npz")
    for path in (tmp_path, tmp_path / "x.png"):
        path.touch()
        with pytest.raises(ValueError, match=r"must be an \.npz file that sts\.save wrote"):
            sts.load(path)


@pytest.mark.parametrize(
    ("thing", "panels"),
    [
        (FRAME, ["visual", "tactile", "depth (mm)", "pressure (kPa)"]),
        (PREDICTION, ["visual: predicted", "tactile: predicted"]),
        (FRAME.visual, [""]),
        (np.zeros((4, 5, 3), np.uint8), [""]),
    ],
)
def test_a_figure_has_the_panels_of_its_object(thing, panels):
    figure = sts.show(thing, title="title")
    titles = [axes.get_title() for axes in figure.axes if axes.images and axes.get_label() != "<colorbar>"]
    assert titles == panels
    assert figure.get_suptitle() == "title"
    with Image.open(io.BytesIO(figure._repr_png_())) as picture:  # for a notebook
        assert np.asarray(picture.convert("L")).std() > 1
    image = np.asarray(getattr(thing, "visual", thing))
    np.testing.assert_allclose(figure.axes[0].images[0].get_array(), image / (255 if image.dtype == np.uint8 else 1))


def sampled(k, *steps, streams=("visual", "tactile"), seed=0):
    """A prediction with random images, k samples and poses 9 to 12 cm above the pad."""
    rng = np.random.default_rng(seed)
    shapes = {"visual": (4, 6, 3), "tactile": (4, 6, 3), "pose": (7,)}

    def values(*lead):
        every = {name: rng.random((*lead, *steps, *shape)) for name, shape in shapes.items()}
        every["pose"][..., 3:] = [1, 0, 0, 0]
        every["pose"][..., :3] *= [0, 0, 0.03]
        every["pose"][..., 2] += 0.09
        latent = dict.fromkeys(("mean", "log_var"), jnp.zeros((*steps, 2)))
        return {name: every[name] if name in (*streams, "pose") else None for name in shapes} | latent

    return sts.Prediction(**values(), samples=sts.Prediction(**values(k)) if k else None)


def test_a_prediction_has_a_row_of_each_stream_with_input_truth_four_samples_and_a_small_mean():
    prediction, truth = sampled(5), {"tactile": np.full((8, 12, 3), 51, np.uint8)}
    figure = sts.show(prediction, given=FRAME, truth=truth)
    axes = np.array(figure.axes).reshape(2, 7)
    heads = ["input", "truth", "sample 1", "sample 2", "sample 3", "sample 4", "mean"]
    assert [axis.get_title() for axis in axes[0]] == heads
    assert [axis.get_ylabel() for axis in axes[:, 0]] == ["visual", "tactile"]
    for name, row in zip(("visual", "tactile"), axes, strict=True):
        samples = getattr(prediction.samples, name)
        true = [np.full((8, 12, 3), 0.2)] if name == "tactile" else []
        wanted = [np.asarray(getattr(FRAME, name)), *true, *samples[:4], getattr(prediction, name)]
        found = [axis.images[0].get_array() for axis in row if axis.images]
        for image, expected in zip(found, wanted, strict=True):
            np.testing.assert_allclose(image, expected, rtol=1e-6)
    figure.draw_without_rendering()
    widths = np.array([axis.get_position().width for axis in axes[0]])
    np.testing.assert_allclose(widths[-1] / widths[:-1], 0.5, rtol=0.05)


def test_a_prediction_of_one_stream_has_one_row_and_without_samples_a_large_mean():
    prediction = sampled(0, streams=("tactile",))
    figure = sts.show(prediction, truth=FRAME)
    assert [axis.get_title() for axis in figure.axes] == ["truth", "predicted"]
    np.testing.assert_array_equal(figure.axes[1].images[0].get_array(), prediction.tactile)
    figure.draw_without_rendering()
    first, second = (axis.get_position().width for axis in figure.axes)
    assert first == pytest.approx(second, rel=0.01)
    assert [axis.get_title() for axis in sts.show(sampled(2, streams=("visual",))).axes] == [
        *("sample 1", "sample 2", "mean")
    ]


def test_the_steps_of_a_rollout_are_drawn_side_by_side():
    steps = jnp.stack([FRAME.visual, 1 - FRAME.visual, FRAME.tactile, FRAME.tactile])
    figure = sts.show(sts.Prediction(steps, 1 - steps, None, jnp.zeros((4, 2)), jnp.zeros((4, 2))))
    upper, lower = (axes.images[0].get_array() for axes in figure.axes)
    assert upper.shape == (4, 24, 3)
    np.testing.assert_array_equal(upper[:, 6:12], 1 - FRAME.visual)
    np.testing.assert_allclose(lower, 1 - upper, atol=1e-6)
    np.testing.assert_array_equal(sts.show(steps).axes[0].images[0].get_array(), upper)
    with pytest.raises(ValueError, match=r"the Prediction has leading axes \(1, 4\)"):
        sts.show(sts.Prediction(steps[None], None, None, None, None))


def test_a_rollout_has_a_strip_for_each_sample_below_its_input_and_truth():
    prediction = sampled(2, 3, streams=("visual",))
    truth = np.stack([FRAME.visual] * 3)
    figure = sts.show(prediction, given=FRAME, truth={"visual": truth})
    titles = [f"visual: {head}" for head in ("input", "truth", "sample 1", "sample 2", "mean")]
    assert [axis.get_title() for axis in figure.axes] == titles
    strips = [np.asarray(axis.images[0].get_array()) for axis in figure.axes]
    assert [strip.shape for strip in strips] == [(4, 6, 3), *[(4, 18, 3)] * 4]
    np.testing.assert_allclose(strips[1][:, 12:], FRAME.visual)
    np.testing.assert_allclose(strips[3][:, 6:12], prediction.samples.visual[1, 1])
    figure.draw_without_rendering()
    boxes = [axis.get_position() for axis in figure.axes]  # the input is about as high as a step
    assert boxes[0].height == pytest.approx(boxes[1].height, rel=0.1)
    assert boxes[0].x0 == pytest.approx(boxes[1].x0, abs=0.01)
    single = sts.show(sampled(2, 1, streams=("visual",)), truth=FRAME)  # a roll-out with last=True
    assert [axis.get_title() for axis in single.axes] == ["truth", "sample 1", "sample 2", "mean"]


@pytest.mark.parametrize("crop", [False, True])
def test_outlines_over_the_input_are_where_the_sensor_would_see_the_object(crop):
    poses = np.zeros((20, 7), np.float32)
    poses[:, 2], poses[:, 3] = 0.06 - 0.002 * np.arange(20), 1
    poses[:, 0] = np.linspace(-0.03, 0.03, 20)
    prediction = sampled(20)
    prediction = prediction._replace(samples=prediction.samples._replace(pose=poses))
    sensor, start = sts.Sensor(), poses[8]
    first = sts.sense(sensor, BODY, start, resolution=(64, 64), crop=crop)
    axis = sts.show(prediction, given=first, body=BODY).axes[0]
    fills = axis.collections[::2]
    assert len(fills) == 16
    centres = np.stack(np.meshgrid(np.arange(64), np.arange(64)), -1).reshape(-1, 2)
    inside, true = fills[8].get_paths()[0].contains_points(centres).reshape(64, 64), np.asarray(first.segmentation)
    assert true.sum() > 100
    assert (inside & true).sum() / (inside | true).sum() > 0.93
    rolled = prediction._replace(visual=np.zeros((2, 4, 6, 3)), tactile=None, samples=None, pose=poses[[0, 8]])
    last = sts.show(rolled, given=first, body=BODY, sensor=sensor).axes[0].collections
    np.testing.assert_array_equal(last[0].get_paths()[0].vertices, fills[8].get_paths()[0].vertices)


BATCH = jax.tree.map(lambda x: jnp.stack([x, x]), FRAME)


@pytest.mark.parametrize(
    ("thing", "more", "error", "message"),
    [
        (FRAME, {"truth": FRAME}, ValueError, "truth is drawn beside a Prediction, but `thing` is a Frame"),
        (BODY, {"body": BODY}, ValueError, "body is drawn beside a Prediction, but `thing` is a Body"),
        (PREDICTION, {"truth": {"pose": np.zeros(7)}}, TypeError, "`truth` is a dict without images"),
        (PREDICTION, {"given": BATCH}, ValueError, r"`given` has shape \(2, 4, 6, 3\), but it must be \(height, width"),
        (
            sampled(1, 3),
            {"truth": FRAME},
            ValueError,
            r"`truth` has shape \(4, 6, 3\), but it must be \(3, height, width",
        ),
        (PREDICTION, {"given": FRAME, "body": BODY}, ValueError, "need a predicted pose, which .*: leave out `body`"),
        (sampled(1), {"body": BODY}, ValueError, "need a visual image in `given`, which is missing"),
        (sampled(0)._replace(visual=None, tactile=None), {}, ValueError, "the prediction has no image"),
    ],
)
def test_what_cannot_be_drawn_with_a_prediction_is_named(thing, more, error, message):
    with pytest.raises(error, match=message):
        sts.show(thing, **more)


def test_a_body_is_drawn_from_outside():
    picture = sts.show(BODY).axes[0].images[0].get_array()
    assert picture.shape == (400, 400, 3)
    assert picture[:20].min() == 1  # white around it
    assert picture.std() > 0.1


@pytest.mark.parametrize(
    ("path", "thing", "error", "message"),
    [
        ("a.npz", np.zeros((2, 2, 3)), TypeError, r"a ndarray, but only a .* Trajectory can be written to an \.npz"),
        ("a.png", BODY, TypeError, r"`thing` is a Body, .* and a \.png file has a Frame or an image"),
        ("a.png", np.full((2, 2, 3), 2.0), ValueError, r"in \[2.0, 2.0\]"),
        ("a.jpg", FRAME, ValueError, r"must end in \.npz"),
        ("a.png", jax.tree.map(lambda x: x[None], FRAME), ValueError, r"leading axes \(1,\)"),
    ],
)
def test_an_object_that_cannot_be_saved_raises_an_error(tmp_path, path, thing, error, message):
    with pytest.raises(error, match=message):
        sts.save(tmp_path / path, thing)
    assert not list(tmp_path.iterdir())


def test_a_frame_prints_in_one_line():
    pressure = f"{float(FRAME.pressure.max()) / 1e3:.3g}"
    assert repr(FRAME) == f"Frame(6 x 4 pixels, object in 25.0% of the view, pressure up to {pressure} kPa, balanced)"
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), FRAME)
    assert repr(batch) == "Frame(2 frames, 6 x 4 pixels)"
    printed = []
    jax.jit(lambda frame: printed.append(repr(frame)))(FRAME)
    assert printed == ["Frame(6 x 4 pixels)"]
