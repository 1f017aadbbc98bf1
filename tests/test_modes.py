"""The library in a new process: settings of JAX, several devices, folders that cannot be written, and quiet output."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from object_files import leaves, mixed_folder
from statespace_config import SMALL, arrays

import sts_jax as sts
from sts_jax import objects, training

HERE = Path(__file__).parent
STRICT = {"JAX_ENABLE_X64": "1", "JAX_NUMPY_DTYPE_PROMOTION": "strict", "JAX_NUMPY_RANK_PROMOTION": "raise"}


def run(code, *arguments, **changes):
    """Run code in a new process with changes of the environment (None: without the variable)."""
    environment = os.environ | {"PYTHONPATH": f"{HERE.parent}{os.pathsep}{HERE}"} | changes
    environment = {name: value for name, value in environment.items() if value is not None}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return done


COLD = """
import importlib, multiprocessing, pkgutil, socket
import jax, sts_jax
for module in pkgutil.walk_packages(sts_jax.__path__, "sts_jax."):
    importlib.import_module(module.name)

def used(queue):
    queue.put(float(sts_jax.geometry.quat_canonical(jax.numpy.array([-1.0, 0, 0, 0]))[0]))

fork = multiprocessing.get_context("fork")
queue = fork.Queue()
worker = fork.Process(target=used, args=(queue,))
worker.start()
assert queue.get(timeout=120) == 1
jax.config.update("jax_num_cpu_devices", 2)
with socket.socket() as free:
    free.bind(("localhost", 0))
    port = free.getsockname()[1]
jax.distributed.initialize(f"localhost:{port}", 1, 0)
assert len(jax.devices()) == 2
"""


def outputs():
    """Results of the library for float64 inputs, by name."""
    key, sensor = jax.random.key(0), sts.Sensor()
    body, pose, wrench = (
        objects.make(key, "bottle"),
        np.array([0.001, 0, 0.03, 1, 0, 0, 0]),
        np.array([0, 0, 1.0, 0, 0, 0]),
    )
    pose, wrench = jnp.asarray(pose), jnp.asarray(wrench)  # float64 in 64-bit mode
    frame = sts.sense(sensor, body, pose, wrench, resolution=(16, 16))
    model = sts.Predictor.load("freefall")
    image = np.array(model.empty["visual"], np.float64)
    image[10:20, 12:22] = 0.2
    found = {
        "frame": frame,
        "vmap": jax.vmap(lambda pose: sts.sense(sensor, body, pose, wrench, resolution=(16, 16)))(pose[None]),
        "expose": sts.expose(sensor, frame, 0.5),
        "touch": sts.touch(sensor, np.full((16, 16), 1e-4)),
        "place": sts.physics.place(body, sensor),
        "trajectory": sts.physics.simulate(key, [body], sensor, sts.physics.Freefall(), 2),
        "prediction": model(visual=image, key=key, num_samples=2),
        "step": trained(),
    }
    return {
        f"{name}{jax.tree_util.keystr(path)}": np.asarray(leaf)
        for name, tree in found.items()
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


def trained():
    """Results of one training step."""
    config = training.TrainConfig(steps=2, batch_size=4)
    learner = training.learner(SMALL)
    graphdef, state = training.initial(config, learner, 2)
    batch = jax.tree.map(jnp.asarray, arrays().take(np.arange(4)))
    return training.step(learner, graphdef, config, 2, state, batch)


@pytest.mark.slow
def test_64_bits_and_strict_promotion_change_no_result(tmp_path):
    run("import sys, test_modes, numpy; numpy.savez(sys.argv[1], **test_modes.outputs())", tmp_path / "x.npz", **STRICT)
    strict, usual = np.load(tmp_path / "x.npz"), outputs()
    assert set(strict) == set(usual)
    for name, value in usual.items():
        assert strict[name].dtype == value.dtype, name
        np.testing.assert_allclose(strict[name], value, rtol=1e-5, atol=1e-6, err_msg=name)


def test_derivatives_and_loops_keep_the_32_bits_of_their_function():
    """The derivative is traced after the function has returned, in the caller's 64 bits."""
    from sts_jax._checked import in_32_bits
    from sts_jax.rendering.loop import looped

    @looped
    def inner(x):
        return jax.lax.fori_loop(0, 3, lambda _, y: jnp.sin(y) * jnp.ones(3), x).sum()

    @in_32_bits
    def outer(x):
        return jax.jit(inner)(jnp.asarray(x, float))

    x = np.linspace(0.1, 1, 6).reshape(2, 3)
    slope = np.prod([np.cos(x), np.cos(np.sin(x)), np.cos(np.sin(np.sin(x)))], axis=0)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        given = jnp.asarray(x)
        for derivative in (jax.grad(outer), jax.jacfwd(outer), jax.jit(jax.grad(outer)), jax.jacrev(outer)):
            np.testing.assert_allclose(jax.vmap(derivative)(given), slope, rtol=1e-5)
        assert jax.vmap(jax.jit(outer))(given).dtype == jnp.float32


MESH = """
import contextlib, jax, numpy as np, jax.numpy as jnp
from jax.sharding import NamedSharding, PartitionSpec
from sts_jax._devices import on_each_device
from sts_jax.rendering.loop import looped

function = looped(lambda x, weight: (jnp.sort(x * weight).reshape(2, 3)[0], x.sum()))
mesh, items = jax.make_mesh((2,), ("batch",)), np.arange(24.0, dtype=np.float32).reshape(4, 6)
weight = np.array([1, -1, 1, -1, 1, -1], np.float32)
truth = [np.sort(items * weight)[:, :3], items.sum(1)]
slope = np.where(np.argsort(np.argsort(items * weight)) < 3, weight, 0) + 1
mapped = jax.vmap(lambda x: function(x, weight))
sloped = jax.vmap(jax.grad(lambda x: sum(part.sum() for part in function(x, weight))))
for context in (contextlib.nullcontext(), jax.set_mesh(mesh)):
    with context:
        for spec in ((), ("batch",)):
            given = jax.device_put(items, NamedSharding(mesh, PartitionSpec(*spec)))
            for run in (mapped, jax.jit(mapped)):
                for found, expected in zip(run(given), truth):
                    np.testing.assert_allclose(found, expected)
            np.testing.assert_allclose(jax.jit(sloped)(given), slope)
"""


def test_importing_leaves_the_backend_of_jax_cold_and_a_loop_over_a_batch_runs_on_a_mesh_with_explicit_axes():
    """Each device of the mesh loops over its own items."""
    run(COLD + MESH, JAX_PLATFORMS="cpu")


PREDICTION = """
import jax, numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from statespace_config import state_model
import sts_jax as sts

made, rng = state_model(), np.random.default_rng(0)
blank = np.full((*made.preprocessing.resolution, 3), (150, 160, 200), np.uint8)
predict = sts.Predictor(made.model, made.preprocessing, (blank, blank), "mesh")
images = np.clip(predict.empty["visual"] + rng.normal(0, 0.1, (4, *blank.shape)), 0, 1).astype(np.float32)
condition = np.zeros((4, made.model.config.condition), np.float32)
truth = predict(visual=images, condition=condition)
sharding = NamedSharding(jax.make_mesh((2,), ("batch",)), PartitionSpec("batch"))
mapped = jax.vmap(lambda image, condition: predict(visual=image, condition=condition))
found = mapped(*jax.device_put((images, condition), sharding))
for leaf, expected in zip(jax.tree.leaves(found), jax.tree.leaves(truth), strict=True):
    np.testing.assert_allclose(leaf, expected, atol=5e-4)
    assert leaf.sharding.spec[0] == "batch"
"""


@pytest.mark.slow
def test_a_predictor_is_mapped_over_a_mesh_with_explicit_axes():
    run(PREDICTION, JAX_NUM_CPU_DEVICES="2")


CACHE = """
import jax, jax.numpy as jnp, sts_jax
print(sts_jax.enable_compilation_cache())
assert jax.jit(lambda x: jnp.sin(x) @ x.T)(jnp.zeros((30, 30))).sum() == 0
"""


def test_the_second_session_with_a_filled_cache_is_quiet(tmp_path):
    for _ in range(2):
        done = run(
            CACHE,
            XDG_CACHE_HOME=str(tmp_path),
            JAX_COMPILATION_CACHE_DIR=None,
            TF_CPP_MIN_LOG_LEVEL=None,
            JAX_PLATFORMS="cpu",
        )
        assert "aot_loader" not in done.stderr
        assert "SIGILL" not in done.stderr
        assert list(Path(done.stdout.strip()).iterdir())


@pytest.mark.parametrize("place", ["file", "home", "full"])
def test_a_cache_that_cannot_be_written_is_a_warning(place, tmp_path, request, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    (tmp_path / "file").write_text("")
    if place == "home":
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setattr(os.path, "expanduser", str)
    if place == "full":
        monkeypatch.setenv("XDG_CACHE_HOME", str(request.getfixturevalue("small_disk")))
    changed = []
    monkeypatch.setattr(jax.config, "update", lambda *setting: changed.append(setting))
    with pytest.warns(UserWarning, match="compiled programs are not kept, because .* cannot be written"):
        folder = sts.enable_compilation_cache()
    assert (folder is not None) == (place == "full")  # a folder that exists is still read
    assert ("jax_persistent_cache_min_compile_time_secs", float("inf")) in changed


@pytest.mark.parametrize("name", ["lr=[0.1]", "[ a*b what?", "{a}#%41 é"])
def test_a_folder_may_have_any_name(name, tmp_path):
    config = training.TrainConfig(steps=2, batch_size=8, log_every=1, checkpoint_every=1)
    model = training.train(config, SMALL, arrays(), workdir=tmp_path / name / "model")
    loaded = training.load(tmp_path / name / "model")
    for one, other in zip(jax.tree.leaves(model.state), jax.tree.leaves(loaded.state), strict=True):
        np.testing.assert_array_equal(one, other)
    library = objects.library(mixed_folder(tmp_path / name / "meshes"), cache=tmp_path / name / "cache")
    assert len(objects.bodies(library)[0]) == 4
    assert len(list((tmp_path / name / "cache").iterdir())) == 4


def test_objects_load_with_a_cache_that_cannot_be_written(tmp_path):
    folder = mixed_folder(tmp_path / "meshes")
    (tmp_path / "cache").write_text("")
    with pytest.warns(UserWarning, match="objects are not kept, because .*cache cannot be written") as caught:
        found, skipped = objects.bodies(objects.library(folder, cache=tmp_path / "cache"))
    assert (len(found), len(caught), skipped) == (4, 1, [])
    plain = objects.bodies(objects.library(folder))[0]
    assert [leaves(body) for body in found] == [leaves(body) for body in plain]
