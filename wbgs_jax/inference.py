"""Rendering many spectra of a trained field on the host: blocks of equal size, one compilation, the geometry planned once."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields import Field
from wbgs_jax.types import Query, Receiver

BLOCK = 16


def make_predictor(field: Field, params: Any, receiver: Receiver) -> Callable[[Query], Any]:
    """A jitted Query -> PAS with the receiver's geometry folded in."""
    plan = field.plan(params, receiver)
    render = jax.jit(field.render)
    return lambda query: render(params, plan, query)


def predict_spectra(field: Field, params: Any, dataset: Dataset, index: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 90 360"]:
    """Predicted spectra (float32) of some of a dataset's queries."""
    predictor = make_predictor(field, params, dataset.receiver)
    images = np.empty((len(index), 90, 360), np.float32)
    for start in range(0, len(index), BLOCK):
        part = index[start : start + BLOCK]
        padded = np.concatenate([part, np.repeat(part[-1:], BLOCK - len(part))])
        images[start : start + BLOCK] = np.asarray(predictor(dataset.query(padded)))[: len(part)]
    return images
