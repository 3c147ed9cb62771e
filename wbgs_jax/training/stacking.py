"""Stacking: the weights of a mixture of spectra, functions of one number, by which known spectra are explained best (SSIM)."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

STRIDE = 8
"""Pixels between the windows by which mixtures are compared."""
STEPS, RATE = 200, 0.1
"""Of Adam, which finds the weights."""
_C1, _C2 = 0.01**2, 0.03**2


class Moments(NamedTuple):
    """What the SSIM of any mixture of K spectra with their truth follows from, window by window."""

    means: Float[Array, "n windows k+1"]
    products: Float[Array, "n windows k+1 k+1"]
    """Covariances; the truth comes last."""


def moments_of(spectra: Float[np.ndarray, "n k 90 360"], truth: Float[np.ndarray, "n 90 360"]) -> Moments:
    """Returns the moments of scikit-image's windows of 7 x 7 pixels, some of them."""
    means, products = [], []
    for own, observed in zip(spectra, truth, strict=True):
        together = np.concatenate([own, observed[None]])
        windows = np.lib.stride_tricks.sliding_window_view(together, (7, 7), (1, 2))[:, ::STRIDE, ::STRIDE]
        windows = windows.reshape(len(together), -1, 49)
        mean = windows.mean(-1)
        centred = windows - mean[..., None]
        means.append(mean.T)
        products.append(np.einsum("awp,bwp->wab", centred, centred) / 48)
    return Moments(jnp.asarray(np.stack(means)), jnp.asarray(np.stack(products)))


def ssim_of(moments: Moments, weights: Float[Array, "n k"]) -> Float[Array, " n"]:
    """Returns the SSIM of mixtures."""
    mean, truth = jnp.einsum("nwk,nk->nw", moments.means[..., :-1], weights), moments.means[..., -1]
    cross = moments.products[..., :-1, :]
    own = jnp.einsum("nwkl,nk,nl->nw", cross[..., :-1], weights, weights)
    both = jnp.einsum("nwk,nk->nw", cross[..., -1], weights)
    luminance = (2 * mean * truth + _C1) / (mean**2 + truth**2 + _C1)
    structure = (2 * both + _C2) / (own + moments.products[..., -1, -1] + _C2)
    return jnp.mean(luminance * structure, -1)


@jax.jit
def fit_weights(
    moments: Moments, u: Float[Array, " n"], prior: Float[Array, "k 2"], ridge: Float[Array, "k 2"]
) -> Float[Array, "k 2"]:
    """Returns the logits of the weights by which spectra are explained best.

    Args:
        moments: of spectra and truths.
        u: what the logits are linear in.
        prior: bias and slope of every logit as long as nothing contradicts.
        ridge: penalties, in SSIM, on the squared distance of each from it.
    """
    optimizer = optax.adam(RATE)

    def loss(logits: Float[Array, "k 2"]) -> Float[Array, ""]:
        weights = jax.nn.softmax(logits[:, 0] + logits[:, 1] * u[:, None], -1)
        return jnp.sum(ridge * (logits - prior) ** 2) - jnp.mean(ssim_of(moments, weights))

    def step(carry: Any, _: None) -> Any:
        logits, state = carry
        updates, state = optimizer.update(jax.grad(loss)(logits), state)
        return (optax.apply_updates(logits, updates), state), None

    (logits, _), _ = jax.lax.scan(step, (prior, optimizer.init(prior)), None, STEPS)
    return logits
