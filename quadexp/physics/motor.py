"""Thrust loss of a motor (Torrente et al. 2021, simplified simulation).

    loss = k u^2 / u_max        with u the commanded and u_max the largest thrust        N

On normalised commands a = u / u_max this is k a^2; the published simulation has k = 0.1 / 1.3^2.
"""

from __future__ import annotations

from quadexp.physics.expression import Expression


def thrust_loss(command: Expression, coefficient: Expression, thrust_max: float) -> Expression:
    """Mean thrust lost by each rotor, (n,) (N); command (n,) (N), coefficient k (-)."""
    return coefficient * command * command / thrust_max
