"""A function of one sample at all samples of a flight, without a matrix of all of them in CasADi."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

BATCH = 20_000  # samples evaluated per call


def evaluate_rows(function: Any, arguments: Sequence[np.ndarray], result: np.ndarray) -> None:
    """Write into the rows of `result`, (k, m), what a CasADi function of dense vectors makes of the rows of its
    arguments, (k, ..) each.

    Through buffers, batch by batch: conversions to CasADi's matrices take seven times as long as the evaluation.
    """
    batch = min(BATCH, len(result))
    if not batch:
        return
    buffers: list[Any] = [np.zeros((batch, array.shape[1])) for array in (*arguments, result)]
    handle, evaluate = function.map(batch).buffer()
    for i, buffer in enumerate(buffers[:-1]):
        handle.set_arg(i, memoryview(buffer))
    handle.set_res(0, memoryview(buffers[-1]))
    for start in range(0, len(result), batch):
        count = min(batch, len(result) - start)
        for buffer, array in zip(buffers, arguments, strict=False):
            buffer[:count] = array[start : start + count]
        evaluate()
        result[start : start + count] = buffers[-1][:count]
