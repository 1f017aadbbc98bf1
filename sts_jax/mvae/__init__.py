"""A multimodal variational autoencoder (MVAE) for images, vectors and categories, with a product of experts."""

from sts_jax.mvae.convolutions import conv as conv
from sts_jax.mvae.convolutions import conv_transpose as conv_transpose
from sts_jax.mvae.elbo import Terms as Terms
from sts_jax.mvae.elbo import decode as decode
from sts_jax.mvae.elbo import infer as infer
from sts_jax.mvae.elbo import log_evidence as log_evidence
from sts_jax.mvae.elbo import loss as loss
from sts_jax.mvae.elbo import predict as predict
from sts_jax.mvae.elbo import prior as prior
from sts_jax.mvae.gaussian import Gaussian as Gaussian
from sts_jax.mvae.gaussian import kl_divergence as kl_divergence
from sts_jax.mvae.gaussian import kl_standard_normal as kl_standard_normal
from sts_jax.mvae.gaussian import product_of_experts as product_of_experts
from sts_jax.mvae.networks import MVAE as MVAE
from sts_jax.mvae.networks import BatchNorm as BatchNorm
from sts_jax.mvae.networks import Config as Config
from sts_jax.mvae.networks import Modality as Modality
from sts_jax.mvae.networks import init as init
