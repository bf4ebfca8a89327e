"""Geometry for thermodynamic integrators: Lie algebras, their groups, Casimirs and Poisson structures.

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
from .contact import (  # noqa: E402
    CanonicalContact,
    ContactForm,
    ContactStructure,
    Cosymplectic,
    ExtendedPhaseSpace,
    LagrangianContact,
    SplitContact,
)
from .errors import (  # noqa: E402
    AntisymmetryError,
    ClosureError,
    ComponentError,
    DomainError,
    JacobiError,
    LieAlgebraError,
    ManifoldsError,
    ParameterError,
    RepresentationError,
    ShapeError,
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

__all__ = [
    "GL",
    "SE",
    "SL",
    "SO",
    "SU",
    "AntisymmetryError",
    "Canonical",
    "CanonicalContact",
    "ClosureError",
    "ComponentError",
    "ContactForm",
    "ContactStructure",
    "Cosymplectic",
    "DomainError",
    "ExtendedPhaseSpace",
    "Heisenberg",
    "JacobiError",
    "LagrangianContact",
    "LieAlgebra",
    "LieAlgebraError",
    "LiePoisson",
    "ManifoldsError",
    "MatrixGroup",
    "NoPolynomialCasimirWarning",
    "ParameterError",
    "PoissonStructure",
    "PoissonTensor",
    "Polynomial",
    "RepresentationError",
    "ShapeError",
    "Sp",
    "SplitContact",
    "abelian",
    "aff",
    "bianchi",
    "direct_sum",
    "galilei",
    "gl",
    "heisenberg",
    "registered",
    "registered_groups",
    "se",
    "semidirect_sum",
    "sl",
    "so",
    "sp",
    "su",
]
