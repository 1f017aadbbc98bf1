"""The first steps of a new user, timed in a new process."""

import os
import time

CLASS = "scissors"


def stamps() -> dict[str, float]:
    """Time the first steps of a new user, such as the imports, the first image, a gradient and 64 simulated falls."""
    begun = time.perf_counter()
    found: dict[str, float] = {}

    def stamp(name: str) -> None:
        found[name] = time.perf_counter() - begun

    import jax
    import jax.numpy as jnp

    import sts_jax as sts

    sts.enable_compilation_cache()
    stamp("import")
    body = sts.objects.make(jax.random.key(0), CLASS)
    sensor = sts.Sensor()
    pose, wrench = sts.physics.place(body, sensor)
    stamp("make and place a body")
    sts.show(sts.sense(sensor, body, pose, wrench, resolution=(240, 320))).savefig(os.devnull, format="png")
    stamp("first picture (240 x 320)")
    jax.block_until_ready(sts.sense(sensor, body, pose, wrench, resolution=(64, 64)).visual)
    stamp("another resolution (64 x 64)")
    darkness = jax.jit(jax.grad(lambda p: jnp.sum(sts.sense(sensor, body, p, wrench, resolution=(64, 64)).tactile)))
    jax.block_until_ready(darkness(pose))
    stamp("gradient (64 x 64)")
    falls = sts.physics.simulate(jax.random.key(1), body, sensor, sts.physics.Freefall(), num=64)
    jax.block_until_ready(falls.pose)
    stamp("64 falls")
    return found
