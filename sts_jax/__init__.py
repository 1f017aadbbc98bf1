"""The See-Through-your-Skin (STS) visuotactile sensor in JAX: simulation, rendering and learned prediction."""

from sts_jax import dataset as dataset
from sts_jax import environments as environments
from sts_jax import evaluation as evaluation
from sts_jax import geometry as geometry
from sts_jax import mvae as mvae
from sts_jax import objects as objects
from sts_jax import optics as optics
from sts_jax import physics as physics
from sts_jax import scene as scene
from sts_jax import storage as storage
from sts_jax import tactile as tactile
from sts_jax import training as training
from sts_jax.compilation import enable_compilation_cache as enable_compilation_cache
from sts_jax.display import load as load
from sts_jax.display import save as save
from sts_jax.display import show as show
from sts_jax.frame import Frame as Frame
from sts_jax.frame import expose as expose
from sts_jax.frame import sense as sense
from sts_jax.frame import touch as touch
from sts_jax.predict import Prediction as Prediction
from sts_jax.predict import Predictor as Predictor
from sts_jax.sensor import Sensor as Sensor

__version__ = "0.1.0"
