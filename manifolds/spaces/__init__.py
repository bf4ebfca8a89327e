"""State spaces: Riemannian manifolds with geodesics in JAX; one base class and its native instances."""

from .base import Space, registered_spaces
from .correlation import Correlation
from .euclidean import Euclidean
from .flag import Flag
from .grassmann import Grassmann
from .groups import GroupSpace, SpecialEuclidean, SpecialOrthogonal, SpecialUnitary
from .homogeneous import Homogeneous
from .hyperbolic import Hyperbolic
from .level_set import LevelSet
from .product import Oblique, Power, Product
from .spd import SPD
from .sphere import Sphere
from .stiefel import Stiefel
from .tangent_bundle import TangentBundle

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
