"""The smallest state-space model, which compiles in seconds."""

from sts_jax import statespace

TINY = statespace.Config(
    input_size=16,
    image_size=16,
    look=4,
    components=2,
    window=8,
    encoder=(4, 4, 4),
    decoder=(8, 4, 4, 4),
    hidden=16,
    transition=16,
    canvas=16,
)
