"""Rigid bodies: their orientation during a run, the periods of their free motion, and the time to reach a spin.

Units are SI or any other consistent ones; angles are in radians.
"""

from __future__ import annotations

from manifolds._names import public_dir

from .models.free_motion import Periods, damping_time, periods, rate_of
from .models.inertia import PrincipalAxes, principal_axes
from .models.jointed_bodies import JointedBodies, Tree
from .models.joints import Hinge, Slider, Universal
from .results.orientation import nutation, precession, quaternions, spin

__all__ = [
    "Hinge",
    "JointedBodies",
    "Periods",
    "PrincipalAxes",
    "Slider",
    "Tree",
    "Universal",
    "damping_time",
    "nutation",
    "periods",
    "precession",
    "principal_axes",
    "quaternions",
    "rate_of",
    "spin",
]
__dir__ = public_dir(__all__)
