"""A configuration is checked before anything is collected."""

import dataclasses

import pytest

from experiments import freefall, inclined, perturbed, released
from experiments.shared import config, run
from sts_jax import dataset, training

PRESETS = {
    f"{experiment.__name__}-{name}": preset
    for experiment in (freefall, inclined, perturbed, released)
    for name, preset in experiment.PRESETS.items()
}


def changed(preset=freefall.SMOKE, collection=None, **fields):
    return dataclasses.replace(
        preset, collection=dataclasses.replace(preset.collection, **(collection or {})), **fields
    )


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_can_be_run(name):
    config.check(PRESETS[name])


@pytest.mark.parametrize(
    ("model", "side", "sizes"),
    [
        ("statespace", 128, (16, 32, 64, 128)),
        ("statespace", 96, (16, 24, 32, 48, 96)),
        ("paper", 128, (32, 64, 128)),
        ("paper", 96, (32, 48, 96)),
    ],
)
def test_image_sizes_divide_the_resolution_and_suit_the_networks(model, side, sizes):
    found = changed(model=model, collection={"resolution": (side, side)}, image_size=sizes[0])
    assert config.image_sizes(found) == sizes
    config.check(found)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"image_size": 48},
            r"image_size must be one of 16, 32, 64, 128 for collection\.resolution 128 128 and model 'statespace', "
            r"got 48: give --image-size 32, or",
        ),
        ({"image_size": 16, "model": "paper"}, r"image_size must be one of 32, 64, 128 .* model 'paper', got 16"),
        (
            {"collection": {"resolution": (96, 128)}},
            r"collection\.resolution must be square, got 96 x 128: give --collection\.resolution 96 96",
        ),
        ({"collection": {"resolution": (8, 8)}}, r"collection\.resolution must be a size .* got 8 x 8: give"),
        (
            {"collection": {"crop": True}},
            r"collection\.crop is True, but it must be False .*: give --collection\.no-crop, or --model paper",
        ),
        ({"model": "paper", "steps": (5,)}, r"steps must have one number for each model \(mvae, .*\), got \(5,\)"),
        (
            {"state_training": training.TrainConfig(steps=100, warmup=150, schedule="cosine")},
            r"state_training\.warmup must be smaller than state_training\.steps \(100\), got 150: give --state-",
        ),
        ({"rerolls": 0}, "rerolls must be >= 1, got 0"),
        ({"num_samples": -1}, "num_samples must be >= 1, got -1"),
        ({"splits": ("frame",)}, r"splits must be one or more of object, trajectory, got \('frame',\)"),
        ({"splits": ()}, r"splits must be one or more of object, trajectory, got \(\)"),
    ],
)
def test_a_field_out_of_range_is_an_error_before_the_collection(fields, message, tmp_path, monkeypatch):
    monkeypatch.setattr(dataset, "collect", lambda *args, **kwargs: pytest.fail("collected"))
    with pytest.raises(ValueError, match=message):
        run.main(changed(**fields), tmp_path / "run")
    assert not (tmp_path / "run").exists()
