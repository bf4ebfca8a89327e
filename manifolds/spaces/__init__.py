"""State spaces: Riemannian manifolds with geodesics in JAX; one base class and its native instances."""

from .base import Space, registered_spaces
from .constant_curvature import Euclidean, Hyperbolic, Sphere
from .groups import GroupSpace, SpecialEuclidean, SpecialOrthogonal, SpecialUnitary
from .homogeneous import Flag, Homogeneous
from .level_set import LevelSet
from .product import Oblique, Power, Product, TangentBundle
from .spd import SPD, Correlation
from .stiefel import Grassmann, Stiefel

__all__ = [
    "SPD",
    "Correlation",
    "Euclidean",
    "Flag",
    "Grassmann",
    "GroupSpace",
    "Homogeneous",
    "Hyperbolic",
    "LevelSet",
    "Oblique",
    "Power",
    "Product",
    "Space",
    "SpecialEuclidean",
    "SpecialOrthogonal",
    "SpecialUnitary",
    "Sphere",
    "Stiefel",
    "TangentBundle",
    "registered_spaces",
]
