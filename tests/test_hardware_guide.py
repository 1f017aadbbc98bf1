"""The guide on scripted images: what is placed, held, released and left, under noise, drift and flicker."""

import numpy as np
import pytest

from sts_jax.hardware import collecting as guide
from sts_jax.hardware.collecting import GuideConfig, Stage

CONFIG = GuideConfig()
STEP_S = 0.15  # between pairs
SIZE = (120, 160)


class Scene:
    """Images of a pad with a dark spot, with noise of single pixels, and a guide that sees them."""

    def __init__(self, *, noise=2.0, seed=0, state=None, config=CONFIG):
        self.random = np.random.default_rng(seed)
        self.noise, self.drift, self.spot, self.hand = noise, 0.0, None, None
        self.config, self.time_s, self.ends = config, 0.0, []
        self.state = state or guide.State(trusted=True)

    def image(self, level, spots):
        values = np.full((*SIZE, 3), level + self.drift)
        for column, row, radius in filter(None, spots):
            y, x = np.mgrid[: SIZE[0], : SIZE[1]]
            values[(x - column) ** 2 + (y - row) ** 2 < radius**2] -= 50
        values += self.random.normal(0, self.noise, values.shape)
        return np.clip(np.round(values), 0, 255).astype(np.uint8)

    def see(self):
        self.time_s += STEP_S
        # The hand is visible through the skin, but does not touch it.
        visual, tactile = self.image(80, [self.spot, self.hand]), self.image(200, [self.spot])
        self.state, end = guide.step(self.config, self.state, guide.observe(self.time_s, visual, tactile))
        if end is not None:
            self.ends.append(end)
        return self.state.stage

    def until(self, stage, limit=40):
        for count in range(limit):
            if self.see() is stage:
                return count
        raise AssertionError(f"the stage stays {self.state.stage}")


def placed(until=Stage.RELEASE, **options):
    """A scene in which an object is held until a stage."""
    scene = Scene(**options)
    scene.until(Stage.PLACE)
    scene.spot = (60, 60, 12)
    scene.until(until)
    return scene


@pytest.mark.parametrize("noise", [2.0, *(pytest.param(noise, marks=pytest.mark.slow) for noise in (0.0, 12.0))])
def test_a_whole_trajectory(noise):
    scene = Scene(noise=noise)
    scene.until(Stage.PLACE)
    assert all(scene.see() is Stage.PLACE for _ in range(100))  # noise is no contact
    scene.spot = scene.hand = (60, 60, 12)
    scene.until(Stage.RELEASE)
    assert all(scene.see() is Stage.RELEASE for _ in range(100))  # noise is no movement
    scene.hand = None
    for column in range(60, 100, 8):
        scene.spot = (column, 60, 12)
        assert scene.see() is Stage.STILL
    scene.until(Stage.REVIEW)
    assert scene.ends == ["initial", "final"]
    scene.state = guide.confirm(scene.state)
    assert all(scene.see() is Stage.CLEAR for _ in range(20))  # the object is still there
    scene.spot = None
    scene.until(Stage.PLACE)


def test_no_pair_is_taken_while_something_moves_or_creeps():
    scene = Scene()
    scene.until(Stage.PLACE)
    for count in range(60):
        scene.spot = (40 + count, 60, 12)
        scene.see()
    assert scene.state.stage is Stage.HOLD
    assert scene.ends == []
    assert scene.until(Stage.RELEASE) >= CONFIG.hold_s / STEP_S - 1
    scene.state = guide.confirm(scene.state)
    for count in range(60):
        scene.spot = (40 + 0.5 * count, 60, 12)  # half a pixel between two pairs
        assert scene.see() is Stage.STILL
    assert scene.until(Stage.REVIEW) >= CONFIG.rest_s / STEP_S - 1


@pytest.mark.parametrize(("watched", "expected"), [("both", Stage.STILL), ("tactile", Stage.REVIEW)])
def test_a_moving_hand_delays_the_final_pair_unless_only_touch_is_watched(watched, expected):
    scene = placed(config=GuideConfig(watched=watched))
    scene.spot = (90, 60, 12)
    for count in range(30):
        scene.hand = (30 + 3 * count, 30, 10)
        scene.see()
    assert scene.state.stage is expected


def test_an_object_that_is_taken_away_is_placed_again_and_one_that_falls_off_ends_the_trajectory():
    for held_until, then, ends in ((Stage.HOLD, Stage.PLACE, 0), (Stage.RELEASE, Stage.REVIEW, 2)):
        scene = placed(held_until)
        scene.spot = None
        scene.until(then)
        assert len(scene.ends) == ends


def test_an_object_that_stays_needs_a_confirmation():
    scene = placed()
    assert "confirm" not in guide.instruction(CONFIG, scene.state)
    for _ in range(80):
        scene.see()
    assert "If the object stays where it was, confirm" in guide.instruction(CONFIG, scene.state)
    scene.state = guide.confirm(scene.state)
    scene.until(Stage.REVIEW)


def test_slow_drift_of_the_light_is_followed_between_trajectories_and_is_no_contact():
    scene = Scene()
    for _ in range(5):
        scene.until(Stage.PLACE)
        for _ in range(10):
            scene.drift += 0.4
            assert scene.see() is Stage.PLACE
        scene.spot = (60, 60, 12)
        scene.until(Stage.RELEASE)
        scene.spot = (80, 60, 12)
        scene.until(Stage.REVIEW)
        scene.state, scene.spot = guide.confirm(scene.state), None


def test_a_speck_is_no_contact_but_an_imprint_within_one_block_is():
    scene = Scene(noise=0.5)
    scene.until(Stage.PLACE)
    scene.spot = (61, 61, 1)  # one pixel within a small block of 2.5 x 2.5 pixels
    assert all(scene.see() is Stage.PLACE for _ in range(20))
    scene.spot = (62.5, 62.5, 2.5)  # block 12 of 24 from above, which has the pixels 60 to 64
    scene.until(Stage.RELEASE)


@pytest.mark.parametrize("known", [False, True])
def test_an_object_that_was_left_is_seen_on_a_known_pad_and_an_unknown_pad_waits_for_the_person(known):
    blank = Scene(seed=1)
    empty = guide.known_pad(blank.image(80, []), blank.image(200, [])) if known else None
    scene = Scene(state=guide.State(empty=empty))
    scene.spot = (60, 60, 12)
    assert all(scene.see() is Stage.CLEAR for _ in range(20))
    assert guide.instruction(CONFIG, scene.state).endswith("Then confirm.") == (not known)
    scene.spot = None
    if not known:
        scene.state = guide.confirm(scene.state)
    scene.until(Stage.PLACE)
    assert not scene.state.trusted


def test_noise_is_measured():
    random = np.random.default_rng(0)
    sizes = (24, 32), (24, 32), (48, 64)
    looks = [[random.normal(100, 2, (*size, 3)).astype(np.float32) for size in sizes] for _ in range(200)]
    measured = guide.empty_pad([guide.Observation(float(number), *look) for number, look in enumerate(looks)])
    np.testing.assert_allclose(measured.noise.visual.mean(), 2, rtol=0.05)
    np.testing.assert_allclose(measured.noise.imprint.mean(), 2, rtol=0.05)
    np.testing.assert_allclose(measured.mean.tactile, 100, atol=1)


def test_an_interruption_starts_the_rest_anew_and_discarding_returns_to_the_beginning():
    scene = placed(Stage.HOLD)
    for _ in range(30):
        scene.see()
        scene.state = guide.interrupted(scene.state)
    assert scene.state.stage is Stage.HOLD
    assert guide.discard(scene.state).stage is Stage.CLEAR


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rest_s", float("nan"), "must be > 0 and finite"),
        ("pairs", 2, ">= 3, got 2"),
        ("largest_threshold", 1.0, ">= s"),
    ],
)
def test_bad_settings_are_refused(name, value, message):
    with pytest.raises(ValueError, match=f"{name} .*{message}"):
        GuideConfig(**{name: value})
