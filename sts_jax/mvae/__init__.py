"""A multimodal variational autoencoder (MVAE) for named images and vectors, with a product of experts."""

from sts_jax.mvae.convolutions import conv, conv_transpose
from sts_jax.mvae.elbo import Terms, decode, infer, loss, predict
from sts_jax.mvae.gaussian import Gaussian, kl_standard_normal, product_of_experts
from sts_jax.mvae.networks import MVAE, BatchNorm, Config, Modality, init

__all__ = [
    "MVAE",
    "BatchNorm",
    "Config",
    "Gaussian",
    "Modality",
    "Terms",
    "conv",
    "conv_transpose",
    "decode",
    "infer",
    "init",
    "kl_standard_normal",
    "loss",
    "predict",
    "product_of_experts",
]
