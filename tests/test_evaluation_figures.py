"""Figures show the numbers and pictures they are given."""

import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image
from test_evaluation_results import judged

import sts_jax as sts
from sts_jax import dataset, evaluation
from sts_jax.evaluation import Curve, Predicted, figures
from sts_jax.evaluation.figures import motion, pictures, sheets

FRAMES = 5
TIME = np.linspace(0, 1, FRAMES)
WRENCH = np.zeros((FRAMES, 6))
WRENCH[:, 3] = 0.02 * TIME  # N m
STREAMS = [np.full((FRAMES, size, size, 3), 0.5) for size in (16, 8, 8)]


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are drawn, instead of files."""
    found = []
    monkeypatch.setattr(pictures, "save", lambda figure, path: found.append(figure))
    monkeypatch.setattr(sheets, "_save", lambda figure, path: found.append(figure))
    yield found
    for figure in found:
        plt.close(figure)


def test_a_strip_has_the_force_in_n_and_the_moment_in_mn_m(tmp_path, drawn):
    figures.strip(tmp_path / "a.png", TIME, *STREAMS, WRENCH, num=3)
    force, moment = drawn[0].axes[-2:]
    assert force.get_ylabel() == "force (N)"
    assert "(mN m)" in moment.get_ylabel()
    assert [line.get_label() for line in moment.lines] == ["$M_x$", "$M_y$", "$M_z$"]
    np.testing.assert_array_equal([line.get_ydata() for line in force.lines], WRENCH[:, :3].T)
    np.testing.assert_allclose([line.get_ydata() for line in moment.lines], 1e3 * WRENCH[:, 3:].T)
    assert force.get_xlim() == moment.get_xlim()


@pytest.mark.parametrize("sign", [1, -1])
def test_an_animation_draws_the_moment_below_the_force(tmp_path, sign):
    side, path = 60, tmp_path / "a.gif"
    figures.animation(path, TIME, *STREAMS, sign * WRENCH, np.zeros((FRAMES, 3)), outcome="stands", side=side)
    with Image.open(path) as film:
        assert film.n_frames == FRAMES
        assert film.info["duration"] == 500  # 0.25 s, twice as slow
        pages = []
        for t in range(FRAMES):
            film.seek(t)
            pages.append(np.asarray(film.convert("RGB")).astype(int))

    def blue_rows(page, panel):  # of the curve, not of its name above it
        top = motion._HEAD + side + panel * motion._PANEL
        part = page[top + 20 : top + motion._PANEL, 55:]
        return np.flatnonzero(((part[..., 2] - part[..., 0]) > 80).any(1))

    assert np.ptp(blue_rows(pages[-1], 1)) > 60  # from 0 to 20 mN m
    assert 10 < np.ptp(blue_rows(pages[2], 1)) < 50  # halfway
    assert not len(blue_rows(pages[-1], 0))  # no force: the three curves lie on each other, the last one is on top


def test_ends_are_drawn_in_millimetres_as_the_images_are_oriented(tmp_path, drawn):
    start, truth = np.array([0.01, -0.02, 0.1, 1, 0, 0, 0]), np.array([0.03, 0.04, 0.02, 1, 0, 0, 0])
    rerolled, sampled = (np.tile(truth, (k, 1)) for k in (16, 4))
    sampled[0, 0] = 0.12  # off the pad, and in the figure
    figures.ends(tmp_path / "a.png", (0.15, 0.15), start, truth, rerolled, sampled, title="t")
    left, right = drawn[0].axes
    low, high = left.get_ylim()
    assert low > high  # y points down
    assert right.get_xlim()[1] > 120
    for axis, poses in ((left, rerolled), (right, sampled)):
        first, true, ends = axis.lines
        np.testing.assert_allclose([first.get_xdata()[0], first.get_ydata()[0]], [10, -20])
        np.testing.assert_allclose([true.get_xdata()[0], true.get_ydata()[0]], [30, 40])
        np.testing.assert_allclose(np.transpose([ends.get_xdata(), ends.get_ydata()]), 1e3 * poses[:, :2])


@pytest.mark.parametrize(("last", "scale"), [(0.5, "log"), (-3.0, "linear")])
def test_a_loss_that_becomes_negative_is_drawn_on_a_linear_axis(tmp_path, drawn, last, scale):
    log = [{"step": step, "loss": loss} for step, loss in ((10, 100.0), (20, last))]
    figures.training_curves(tmp_path / "a.png", {"model": log})
    axis = drawn[0].axes[0]
    assert axis.get_yscale() == scale
    assert axis.get_ylim()[0] < last


def test_a_slope_is_drawn_as_a_slope():
    fork = sts.objects.make(jax.random.key(0), "fork")
    red = dataclasses.replace(fork, colors=fork.colors * 0 + jnp.array([1.0, 0, 0]))
    size, slope = jnp.array([0.15, 0.15]), jnp.pi / 6
    up = jnp.array([0.0, -jnp.sin(slope), jnp.cos(slope)])
    stand = jnp.array([1.0, 0, 0, 0])

    def place(position, up):
        picture = np.asarray(evaluation.outside(red, jnp.concatenate([position, stand]), size, up)).astype(float)
        return np.argwhere(picture[..., 0] > picture[..., 1] + 0.3).mean(0)

    level = place(jnp.array([0.0, 0, 0.06]), jnp.array([0.0, 0, 9.81]))
    np.testing.assert_allclose(place(0.06 * up, 9.81 * up), level, atol=2)  # the object above the pad is drawn above it
    downhill = place(jnp.array([0.0, 0.04, 0.06]), 9.81 * up)
    assert downhill[0] > place(jnp.array([0.0, 0.04, 0.06]), None)[0] + 8


NAMES = ("bottle", "fork", "bottle")
SCENE = {"scenario": sts.physics.Freefall(), "names": NAMES, "title": "t"}


def shown(figure):
    """The images of a figure in the order of drawing: from the top row to the bottom, from left to right."""
    return [np.asarray(axis.images[0].get_array()) for axis in figure.axes if axis.images]


def test_a_column_is_chosen_for_each_class_and_then_for_each_object():
    test, _ = judged()  # objects 0, 0, 1, 1, 2, 2
    assert figures.one_of_each(test, NAMES, 2).tolist() == [0, 2]
    assert figures.one_of_each(test, NAMES, 9).tolist() == [0, 2, 4, 1, 3, 5]
    assert figures.one_of_each(test, ("fork", "bottle", "bottle"), 3).tolist() == [2, 0, 4]


def texts(figure):
    return [text.get_text() for text in figure.texts]


def side(axis):
    """Side of an image on the sheet (inches)."""
    return axis.get_position().height * axis.figure.get_figheight()


def test_a_pose_sheet_shows_inputs_truth_four_samples_and_a_small_mean(tmp_path, drawn):
    test, predicted = judged(k=5)
    items = np.array([0, 3])
    figures.pose_sheet(tmp_path / "a.png", test, predicted, items, size=(0.15, 0.15), **SCENE)
    rows, labels = [test.visual[items, 0], test.tactile[items, 0]], ["visual input", "tactile input"]
    for stream in ("visual", "tactile"):
        rows.append(getattr(test, stream)[items, 1])
        rows += list(getattr(predicted.samples, stream)[:4, items])
        rows.append(getattr(predicted, stream)[items])
        labels += [f"true {stream}", *(f"{stream} sample {k}" for k in (1, 2, 3, 4)), f"{stream} mean"]
    for image, wanted in zip(shown(drawn[0]), [image for row in rows for image in row], strict=True):
        np.testing.assert_allclose(image, wanted / 255 if wanted.dtype == np.uint8 else wanted, rtol=1e-6)
    assert [text for text in texts(drawn[0]) if text in labels] == labels
    assert texts(drawn[0])[-3:] == ["bottle\n#0\nrests", "fork\n#3\nfell off", "pose"]
    sides = np.array([side(axis) for axis in drawn[0].axes if axis.images])
    np.testing.assert_allclose(sides[[14, 15, 26, 27]], sides[0] / 2)
    np.testing.assert_allclose(np.delete(sides, [14, 15, 26, 27]), sides[0])


def test_a_prediction_without_samples_is_drawn_large_and_a_touch_without_contact_is_left_out(tmp_path, drawn):
    test, predicted = judged()
    test.contact[[0, 3], 0] = False
    predicted = predicted._replace(samples=None)
    figures.pose_sheet(tmp_path / "a.png", test, predicted, np.array([0, 3]), size=(0.15, 0.15), **SCENE)
    labels = ["visual input", "true visual", "predicted visual", "true tactile", "predicted tactile"]
    assert texts(drawn[0])[1:-3] == labels
    np.testing.assert_allclose(shown(drawn[0])[4], predicted.visual[0], rtol=1e-6)
    assert len({round(side(axis), 6) for axis in drawn[0].axes if axis.images}) == 1


def test_a_red_arrow_is_the_velocity_that_a_jerk_gives(tmp_path, drawn):
    test, predicted = judged()
    jerks = np.tile(np.float32([2.0, 0, 0.25]), (6, 1))  # m/s^2 along x for 0.25 s
    scene = {**SCENE, "scenario": sts.physics.Perturbed()}
    test = test._replace(condition=jerks, outcome=np.ones(6, int))
    figures.pose_sheet(tmp_path / "a.png", test, predicted, np.array([1]), size=(0.15, 0.15), **scene)
    arrow = drawn[0].axes[0].texts[0]
    np.testing.assert_allclose(np.subtract(arrow.xy, arrow.xyann), [-0.5, 0], atol=1e-6)  # 4 pixels are 4 m/s
    assert "Red arrow" in texts(drawn[0])[0].replace("\n", " ")


FORK = sts.objects.make(jax.random.key(0), "fork")
LYING = np.array([0.02, -0.01, 0.004, np.cos(0.4), 0, 0, np.sin(0.4)], np.float32)


@pytest.mark.parametrize("crop", [False, True])
def test_a_silhouette_covers_the_pixels_that_the_sensor_segments(crop):
    frame = sts.sense(sts.Sensor(), FORK, LYING, resolution=(128, 128), crop=crop)
    inside = LYING - np.float32([0, 0, 1, 0, 0, 0, 0])
    poses = np.stack([LYING, inside, np.nan * LYING])
    masks = figures.silhouettes(sts.Sensor().camera, FORK, poses, window=frame.window, shape=(128, 128))
    found, true = masks[0] > 0.5, np.asarray(frame.segmentation)
    assert true.sum() > 300
    assert (found & true).sum() / (found | true).sum() > (0.97 if crop else 0.94)  # along a rim one pixel wide
    assert not masks[1:].any()


def test_outlines_at_sampled_poses_lie_on_the_rims_of_their_segmentations(tmp_path, drawn):
    test, predicted = judged(k=20)
    pixels = np.zeros((6, 2, 64, 64, 3), np.uint8)
    predicted.samples.pose[:, 3] = LYING
    predicted.samples.pose[1:, 3] = np.nan
    figures.pose_sheet(
        tmp_path / "a.png",
        test._replace(visual=pixels),
        predicted,
        np.array([3]),
        size=(0.15, 0.15),
        bodies=[FORK],
        camera=sts.Sensor().camera,
        **SCENE,
    )
    axis = drawn[0].axes[0]
    filled, line = axis.collections
    segmented = np.asarray(sts.sense(sts.Sensor(), FORK, LYING, resolution=(64, 64)).segmentation)
    rows, columns = np.nonzero(segmented)
    for drawing in (filled, line):
        (left, top), (right, bottom) = drawing.get_paths()[0].get_extents().get_points()
        np.testing.assert_allclose([left, right], [columns.min() - 0.5, columns.max() + 0.5], atol=0.75)
        np.testing.assert_allclose([top, bottom], [rows.min() - 0.5, rows.max() + 0.5], atol=0.75)
    centres = np.stack(np.meshgrid(np.arange(64), np.arange(64)), -1).reshape(-1, 2)
    inside = filled.get_paths()[0].contains_points(centres).reshape(64, 64)
    assert (inside & segmented).sum() / (inside | segmented).sum() > 0.85
    assert axis.get_xlim() == (-0.5, 63.5)
    assert "visual input and\npredicted ends" in texts(drawn[0])


def test_the_predicted_frame_is_solid_and_the_true_one_dashed(drawn, tmp_path):
    test, predicted = judged(2)
    up, arm = np.array([1.0, 0, 0, 0]), sheets._ARM * 0.15
    test.pose[:, 1] = [0, 0, 0.02, *up]
    predicted = predicted._replace(pose=np.array([[0, 0, 0.02, *up], [0, 0.04, 0.02, *up]]))
    figures.pose_sheet(tmp_path / "a.png", test, predicted, np.array([0, 1]), size=(0.15, 0.15), **SCENE)
    same, other = ([line.get_xydata() for line in axis.lines] for axis in drawn[0].axes[-2:])
    styles = [line.get_linestyle() for line in drawn[0].axes[-1].lines]
    assert styles == ["-"] * 3 + ["--"] * 3
    np.testing.assert_allclose(same[:3], same[3:], atol=1e-9)
    lengths = [np.linalg.norm(end - start) for start, end in same[:3]]
    view = np.array([0.25, 0.53, 0.35]) / np.linalg.norm([0.25, 0.53, 0.35])
    np.testing.assert_allclose(lengths, arm * np.sqrt(1 - view**2), rtol=1e-6)  # a parallel projection
    assert other[2][1][1] > other[2][0][1]  # up is up
    assert other[0][0][1] < other[3][0][1]  # what is nearer is lower
    assert not drawn[0].axes[-1].texts


def test_a_frame_off_the_pad_is_named_and_an_outline_is_the_projected_hull(drawn, tmp_path):
    test, predicted = judged(2)
    fork = sts.objects.make(jax.random.key(0), "fork")
    test.pose[:, 1] = [0, 0, 0.01, 1, 0, 0, 0]
    predicted = predicted._replace(pose=np.array([[0, 0, -0.4, 1, 0, 0, 0]] * 2))
    figures.pose_sheet(tmp_path / "a.png", test, predicted, np.array([1]), size=(0.15, 0.15), bodies=[fork], **SCENE)
    axis = drawn[0].axes[-1]
    assert axis.texts[0].get_text() == "predicted:\noff the pad"
    _, below, above = (patch.get_xy() for patch in axis.patches)
    np.testing.assert_allclose(np.ptp(below, axis=0), np.ptp(above, axis=0), rtol=1e-6)
    view = np.array([0.25, 0.53, 0.35]) / np.linalg.norm([0.25, 0.53, 0.35])
    up = np.array([0, 0, 1]) - view[2] * view
    heights = (np.asarray(fork.hulls).reshape(-1, 3) + np.array([0, 0, 0.01])) @ up / np.linalg.norm(up)
    np.testing.assert_allclose([above[:, 1].min(), above[:, 1].max()], [heights.min(), heights.max()], atol=1e-6)


def test_a_sheet_of_models_leaves_out_what_a_model_does_not_predict(tmp_path, drawn):
    test, both = judged()
    both = both._replace(samples=None)
    models = {"VAE visual": Predicted(visual=both.visual), "VAE tactile": Predicted(tactile=both.tactile), "MVAE": both}
    figures.models_sheet(tmp_path / "a.png", test, models, np.array([1]), **SCENE)
    labels = [text.get_text() for text in drawn[0].texts][1:-1]
    streams = [[f"true {s}", f"VAE {s}\n{s}", f"MVAE\n{s}"] for s in ("visual", "tactile")]
    assert labels == ["visual input", "tactile input", *streams[0], *streams[1]]
    np.testing.assert_allclose(shown(drawn[0])[7], both.tactile[1], rtol=1e-6)


def test_a_crossed_sheet_predicts_each_stream_from_the_other(tmp_path, drawn):
    test, both = judged()
    from_touch, from_vision = Predicted(visual=both.visual), Predicted(tactile=both.tactile)
    figures.crossed_sheet(tmp_path / "a.png", test, from_touch, from_vision, np.array([2]), **SCENE)
    wanted = [test.tactile[2, 0] / 255, test.visual[2, 1] / 255, both.visual[2]]
    wanted += [test.visual[2, 0] / 255, test.tactile[2, 1] / 255, both.tactile[2]]
    np.testing.assert_allclose(shown(drawn[0]), wanted, rtol=1e-6)


def test_a_strip_of_a_roll_out_has_the_truth_of_the_same_time(tmp_path, drawn):
    rng, stride, steps = np.random.default_rng(0), 2, 7
    images = dataset.Images(*(rng.random((15, 8, 8, 3)) for _ in range(2)), segmentation=None)
    rolled = [Predicted(visual=rng.random((3, 8, 8, 3))) for _ in range(steps)]
    direct = Predicted(visual=rng.random((3, 8, 8, 3)))
    time = 0.1 * np.arange(15)
    figures.rollout_strip(tmp_path / "a.png", time, images, rolled, 1, stride=stride, direct=direct, num=3)
    found = shown(drawn[0])
    np.testing.assert_allclose(found[:5], images.visual[[0, 2, 6, 14, 14]])
    np.testing.assert_allclose(
        found[5:], [rolled[0].visual[1], rolled[2].visual[1], rolled[6].visual[1], direct.visual[1]]
    )
    heads = [text.get_text() for text in drawn[0].texts][-5:]
    assert heads == ["0.00 s\ninput", "0.20 s", "0.60 s", "1.40 s", "1.40 s\ndirect"]


def test_a_strip_of_a_roll_out_has_sampled_courses_above_their_mean(tmp_path, drawn):
    rng = np.random.default_rng(0)
    images = dataset.Images(*(rng.random((6, 8, 8, 3)) for _ in range(2)), segmentation=None)

    def sampled(k):
        return Predicted(tactile=rng.random((3, 8, 8, 3)), samples=Predicted(tactile=rng.random((k, 3, 8, 8, 3))))

    rolled, direct = [sampled(2) for _ in range(5)], sampled(3)
    figures.rollout_strip(tmp_path / "a.png", np.arange(6), images, rolled, 1, direct=direct, num=2)
    found, every = shown(drawn[0]), [rolled[0], rolled[4], direct]
    np.testing.assert_allclose(found[:4], images.tactile[[0, 1, 5, 5]])
    for k in (0, 1):
        np.testing.assert_allclose(found[4 + 3 * k : 7 + 3 * k], [one.samples.tactile[k, 1] for one in every])
    np.testing.assert_allclose(found[10:], [one.tactile[1] for one in every])
    labels = ["true tactile", "tactile sample 1", "tactile sample 2", "tactile mean"]
    assert texts(drawn[0])[1:5] == labels


def test_a_sheet_is_a_small_picture(tmp_path):
    test, predicted = judged(24)
    noise = np.random.default_rng(0).integers(0, 256, (24, 2, 64, 64, 3), np.uint8)
    test = test._replace(visual=noise, tactile=noise // 8 + 100, object=np.zeros(24, int))
    predicted = predicted._replace(visual=noise[:, 0] // 8, tactile=noise[:, 0] // 8)
    path = tmp_path / "a.png"
    figures.pose_sheet(path, test, predicted, np.arange(6), size=(0.15, 0.15), **SCENE)
    assert path.stat().st_size < 900_000  # noise; real images are far smaller
    with Image.open(path) as picture:
        assert picture.width < 1200


def test_curves_are_means_over_the_objects_that_stay(tmp_path, drawn):
    test, predicted = judged()
    near = predicted._replace(pose=test.pose[:, 1] + np.float32([0.003, 0, 0, 0, 0, 0, 0]))
    curve = evaluation.error_curve([0.1, 0.2], [(near, test), (predicted, test)])
    stays = test.outcome == 0
    error = evaluation.metrics.image_error(predicted.visual, test.visual[:, 1] / 255)
    np.testing.assert_allclose(curve.errors["visual"][1], error.excess / error.pixels)
    assert np.isnan(curve.errors["position"][:, ~stays]).all()
    np.testing.assert_allclose(curve.errors["position"][0, stays], 0.003, rtol=1e-4)
    last = Curve(np.array([0.2]), {"visual": curve.errors["visual"][1:]})
    curves = {"steps": curve, "last frame": last, "copy of the input": curve}
    figures.error_curves(tmp_path / "a.png", curves, test.object, title="t", num=50)
    position, visual, _ = drawn[0].axes
    np.testing.assert_allclose(position.lines[0].get_ydata()[0], 3, rtol=1e-4)  # mm
    np.testing.assert_allclose(visual.lines[0].get_ydata(), 1e4 * curve.errors["visual"].mean(1))
    np.testing.assert_allclose(visual.lines[0].get_xdata(), [0.1, 0.2])
    assert len(visual.containers) == 1  # the point of the last frame
    assert visual.lines[-1].get_linestyle() == "--"
    band = visual.collections[0].get_paths()[0].vertices[:, 1]
    assert band.min() < 1e4 * curve.errors["visual"][1].mean() < band.max()


def test_predictions_that_do_not_fit_a_figure_are_named(tmp_path):
    test, both = judged()
    path, steps = tmp_path / "a.png", [both] * 3
    images = dataset.Images(test.visual[:, 0], test.tactile[:, 0], test.segmentation[:, 0])
    with pytest.raises(ValueError, match="3 steps of 2 frames, but the trajectory has 6 frames: give at most 2 steps"):
        figures.rollout_strip(path, np.arange(6), images, steps, 0, stride=2)
    with pytest.raises(ValueError, match=r"from_touch\.visual or from_vision\.tactile is None"):
        figures.crossed_sheet(path, test, Predicted(tactile=both.tactile), both, np.array([0]), **SCENE)
    with pytest.raises(ValueError, match=r"`time` has 1 times, but the numbers of predictions are .*'visual': 2"):
        evaluation.error_curve([0.1], [(both, test), (both, test)])
    assert not path.exists()
