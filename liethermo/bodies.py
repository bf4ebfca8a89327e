"""Rigid bodies: attitudes and rates in and out, the periods of their free motion, and the time to reach a spin.

Units are SI or any other consistent ones; angles are in radians, unless ``degrees=True`` is given. Attitudes map body
axes to axes in space [:doc:`/reference/conventions`].
"""

from __future__ import annotations

from manifolds._arguments import module_dir_function

from .models.bodies_on_ground import BodiesOnGround
from .models.free_motion import Periods, damping_time, periods, rate_of
from .models.inertia import PrincipalAxes, principal_axes
from .models.jointed_bodies import JointedBodies
from .models.joints import Hinge, Slider, Universal
from .models.tree import Tree
from .results.files import AttitudeHistory, read_csv, write_csv
from .results.orientation import (
    angular_momentum,
    angular_velocity,
    euler_angles,
    joint_rates,
    nutation,
    precession,
    quaternions,
    rotation,
    rotor_rates,
    spin,
)
from .systems.rotations import AttitudeWarning, attitude

__all__ = [
    "AttitudeHistory",
    "AttitudeWarning",
    "BodiesOnGround",
    "Hinge",
    "JointedBodies",
    "Periods",
    "PrincipalAxes",
    "Slider",
    "Tree",
    "Universal",
    "angular_momentum",
    "angular_velocity",
    "attitude",
    "damping_time",
    "euler_angles",
    "joint_rates",
    "nutation",
    "periods",
    "precession",
    "principal_axes",
    "quaternions",
    "rate_of",
    "read_csv",
    "rotation",
    "rotor_rates",
    "spin",
    "write_csv",
]
__dir__ = module_dir_function(__all__)
