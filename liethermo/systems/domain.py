"""``Domain``: which states a system allows, and the reasons in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax


def _empty_reason(x) -> str:
    """Return "", the reason of a domain that allows every state."""
    return ""


@dataclass(frozen=True)
class Domain:
    """Conditions that a state must satisfy besides being finite; by default there are none.

    Attributes
    ----------
    description : str
        The conditions in words, such as "positive temperatures".
    why_outside : function from states, shape (n,) or (..., n), to str
        Explains why a state lies outside of the domain; "" if all lie inside.
    why_entropy_gradient_infinite : function from states, shape (n,) or (..., n), to str
        Explains why the gradient of the entropy is infinite at a state, so that no run can start there; "" if it is
        finite at all states.
    margin : function from a state, shape (n,), to a number; optional
        Positive if and only if the parameters of the system allow the state. JAX traces it, for many systems at once.
        None if all parameters allow all states.
    """

    description: str = ""
    why_outside: Callable[[Any], str] = _empty_reason
    why_entropy_gradient_infinite: Callable[[Any], str] = _empty_reason
    margin: Callable[[Any], jax.Array] | None = None

    @property
    def allows_every_start(self) -> bool:
        """True if a run may start at every finite state."""
        return self.why_outside == _empty_reason and self.why_entropy_gradient_infinite == _empty_reason

    def margin_at(self, x) -> jax.Array:
        """Return the margin of the domain at a state, shape (n,): positive if the parameters allow the state."""
        assert self.margin is not None
        return self.margin(x)
