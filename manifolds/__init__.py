"""Geometry for thermodynamic integrators: Lie algebras and groups, Casimirs, Poisson structures, state spaces.

Importing this package switches JAX to 64-bit floating point: the laws are kept to rounding, and single precision would
round them away.
"""

import jax

jax.config.update("jax_enable_x64", True)

from .casimirs import NoPolynomialCasimirWarning  # noqa: E402
from .catalogue import (  # noqa: E402
    abelian,
    aff,
    bianchi,
    galilei,
    gl,
    heisenberg,
    registered,
    se,
    sl,
    so,
    sp,
    su,
)
from .errors import (  # noqa: E402
    AntisymmetryError,
    ClosureError,
    ComponentError,
    DomainError,
    JacobiError,
    LieAlgebraError,
    ManifoldsError,
    OffManifoldError,
    ParameterError,
    RepresentationError,
    ShapeError,
    SpaceError,
)
from .lie_algebra import LieAlgebra, direct_sum, semidirect_sum  # noqa: E402
from .lie_group import (  # noqa: E402
    GL,
    SE,
    SL,
    SO,
    SU,
    Heisenberg,
    MatrixGroup,
    Sp,
    registered_groups,
)
from .poisson import Canonical, LiePoisson, PoissonStructure, PoissonTensor  # noqa: E402
from .polynomial import Polynomial  # noqa: E402
from .spaces import (  # noqa: E402
    SPD,
    Euclidean,
    GroupSpace,
    Hyperbolic,
    Power,
    Product,
    Space,
    SpecialEuclidean,
    SpecialOrthogonal,
    SpecialUnitary,
    Sphere,
    Stiefel,
    registered_spaces,
)

__all__ = [
    "GL",
    "SE",
    "SL",
    "SO",
    "SPD",
    "SU",
    "AntisymmetryError",
    "Canonical",
    "ClosureError",
    "ComponentError",
    "DomainError",
    "Euclidean",
    "GroupSpace",
    "Heisenberg",
    "Hyperbolic",
    "JacobiError",
    "LieAlgebra",
    "LieAlgebraError",
    "LiePoisson",
    "ManifoldsError",
    "MatrixGroup",
    "NoPolynomialCasimirWarning",
    "OffManifoldError",
    "ParameterError",
    "PoissonStructure",
    "PoissonTensor",
    "Polynomial",
    "Power",
    "Product",
    "RepresentationError",
    "ShapeError",
    "Sp",
    "Space",
    "SpaceError",
    "SpecialEuclidean",
    "SpecialOrthogonal",
    "SpecialUnitary",
    "Sphere",
    "Stiefel",
    "abelian",
    "aff",
    "bianchi",
    "direct_sum",
    "galilei",
    "gl",
    "heisenberg",
    "registered",
    "registered_groups",
    "registered_spaces",
    "se",
    "semidirect_sum",
    "sl",
    "so",
    "sp",
    "su",
]
