"""The Fashion-MNIST benchmark: a short training, and its evidence against an integral over two latents."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import fashion
from sts_jax import mvae

needs_data = pytest.mark.skipif(not fashion.DATA.exists(), reason="needs Debian's package dataset-fashion-mnist")
SMALL = fashion.Args(latent=2, hidden=64, widths=(8, 8, 16, 16), epochs=1)


@pytest.mark.slow
@needs_data
def test_a_few_steps_and_the_printed_evidence(tmp_path, capsys, monkeypatch):
    images, labels = fashion.read(fashion.DATA, "t10k")
    assert images.shape == (10_000, 32, 32, 1)
    assert (labels.sum(0) == 1000).all()
    # The published floor of the data set is 189.86 nats.
    assert fashion.ceiling(images) == pytest.approx(-189.86, abs=1.0)
    monkeypatch.setattr(fashion, "read", lambda *_: (images[:500], labels[:500]))
    fashion.main(dataclasses.replace(SMALL, workdir=tmp_path, items=4, num=10))
    out = capsys.readouterr().out
    assert "step 5 of 5" in out
    assert "published -233.0" in out


@needs_data
@pytest.mark.slow
def test_after_an_epoch_the_evidence_equals_an_integral_over_the_latent(tmp_path):
    model = fashion.train(dataclasses.replace(SMALL, workdir=tmp_path), *fashion.read(fashion.DATA, "train"))
    images, labels = (part[:20] for part in fashion.read(fashion.DATA, "t10k"))
    estimates = fashion.evidence(model, images, labels, 2000)

    side = np.linspace(-5, 5, 401)
    cell = 2 * np.log(side[1] - side[0])
    x, joint = jnp.asarray(images / 255, jnp.float32).reshape(20, -1), []
    decode = jax.jit(lambda z: mvae.decode(model.graphdef, model.state, z))
    for row in side:
        z = np.stack(np.broadcast_arrays(row, side), -1)
        out = decode(jnp.asarray(z, jnp.float32))
        logits = out["image"].reshape(len(z), -1)
        image = logits @ x.T - jax.nn.softplus(logits).sum(1)[:, None]
        label = jax.nn.log_softmax(out["label"]) @ jnp.asarray(labels).T
        prior = -0.5 * np.sum(z**2, -1)[:, None] - np.log(2 * np.pi)
        joint.append(np.stack([prior + image, prior + image + label]))
    truth = jax.nn.logsumexp(np.concatenate(joint, axis=1), axis=1) + cell
    for (name, estimate), exact in zip(estimates.items(), truth, strict=True):
        # The estimate is a lower bound in expectation, and tight for most images.
        difference = estimate - exact
        assert np.median(np.abs(difference)) < 0.1, (name, difference)
        assert -1 < difference.mean() < 0.1, (name, difference)
        assert -350 < estimate.mean() < -189.86, name
