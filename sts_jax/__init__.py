"""The See-Through-your-Skin (STS) visuotactile sensor in JAX: simulation, rendering and learned prediction."""

from sts_jax import dataset, evaluation, geometry, mvae, objects, optics, physics, storage, tactile, training
from sts_jax.compilation import enable_compilation_cache
from sts_jax.display import load, save, show
from sts_jax.frame import Frame, expose, sense, touch
from sts_jax.predict import Prediction, Predictor
from sts_jax.sensor import Sensor

__all__ = [
    "Frame",
    "Prediction",
    "Predictor",
    "Sensor",
    "dataset",
    "enable_compilation_cache",
    "evaluation",
    "expose",
    "geometry",
    "load",
    "mvae",
    "objects",
    "optics",
    "physics",
    "save",
    "sense",
    "show",
    "storage",
    "tactile",
    "touch",
    "training",
]
