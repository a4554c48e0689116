"""One integration step of a world, repeated over a control period."""

from __future__ import annotations

from typing import Any

from quadexp.compile.symbolic import ca

WRITTEN_OUT = 100  # integration steps of a control period that are not a loop


def repeated(step: ca.Function, steps: int, state: ca.MX, times: ca.MX, noise: ca.MX, held: Any) -> list[ca.MX]:
    """Results of all steps, column by column. held: still, u, parameters and step, the same for every step.

    Written out, a call a step, what is held is read where it is; a loop needs a copy of it for every step.
    """
    if steps > WRITTEN_OUT:
        again = [ca.repmat(value, 1, steps) for value in held]
        return list(step.mapaccum(steps).call([state, times, *again[:2], noise, *again[2:]]))
    columns = list[list[ca.MX]]()
    for i in range(steps):
        columns.append(list(step.call([state, times[i], *held[:2], noise[:, i], *held[2:]])))
        state = columns[-1][0]
    return [ca.horzcat(*each) for each in zip(*columns, strict=True)]


def trimmed(step: ca.Function) -> tuple[ca.Function, dict[str, list[int]]]:
    """A step without the entries of `still` and `parameters` that it does not use, and those that it does.

    They are copied for every step, which costs more than many an effect.
    """
    places = {"still": 2, "parameters": 5}
    used = {name: [*range(step.size1_in(i))] for name, i in places.items()}
    if not step.is_a("SXFunction"):
        return step, used
    arguments = step.sx_in()
    results = step.call(arguments)
    numbers = ca.veccat(*results)
    for name, i in places.items():
        if not used[name]:
            continue
        needed = ca.which_depends(numbers, arguments[i], 1, False)
        used[name] = [place for place, is_needed in enumerate(needed) if is_needed]
        arguments[i] = arguments[i][used[name]]
    return ca.Function(step.name(), arguments, results), used
