"""Geometry for thermodynamic integrators: Lie algebras and groups, Casimirs, Poisson structures, state spaces.

Importing this package switches JAX to 64-bit floating point: the laws are kept to rounding, and single precision would
round them away.
"""

import importlib

from . import _fork_guard, _precision, testing  # noqa: F401
from ._arguments import module_dir_function
from .algebras.blocks import DirectSum, direct_sum, power, semidirect_sum
from .algebras.casimirs import NoPolynomialCasimirWarning, TracePolynomial
from .algebras.catalogue import abelian, aff, bianchi, g2, galilei, gl, heisenberg, registered, se, sl, so, sp, su, u
from .algebras.isomorphism_type import IsomorphismType
from .algebras.lie_algebra import LieAlgebra, trilinear_form
from .algebras.magnetic import MagneticExtension, magnetic_extension
from .algebras.matrix_algebra import MatrixAlgebra, MatrixTrace
from .algebras.patera import patera
from .algebras.polynomial import Formula, Polynomial
from .errors import (
    AntisymmetryError,
    ClosureError,
    ComponentError,
    DomainError,
    ForkError,
    JacobiError,
    LieAlgebraError,
    ManifoldsError,
    OffManifoldError,
    ParameterError,
    PrecisionError,
    RepresentationError,
    ShapeError,
    SizeError,
    SpaceError,
)
from .groups.catalogue import GL, SE, SL, SO, SU, Heisenberg, Sp
from .groups.matrix_group import MatrixGroup, registered_groups
from .matrices.spectral import ScalarFunction, spectral, spectral_difference, spectral_trace
from .retractions.charts import (
    CayleyRetraction,
    EuclideanRetraction,
    GroupRetraction,
    MidpointRetraction,
    PolarRetraction,
    ProjectionRetraction,
    QRRetraction,
    RiemannianRetraction,
    StiefelCayleyRetraction,
    retraction,
)
from .retractions.retraction import Chart, Coordinates, Place, Retraction, coordinates_around
from .spaces import (
    SPD,
    Correlation,
    Euclidean,
    Flag,
    Grassmann,
    GroupSpace,
    Homogeneous,
    Hyperbolic,
    LevelSet,
    Oblique,
    Power,
    Product,
    Space,
    SpecialEuclidean,
    SpecialOrthogonal,
    SpecialUnitary,
    Sphere,
    Stiefel,
    TangentBundle,
    registered_spaces,
)
from .spaces.geomstats_bridge import GeomstatsSpace, from_geomstats
from .spaces.statistics import dispersion, frechet_mean
from .structures.contact import (
    CanonicalContact,
    ContactForm,
    ContactStructure,
    Cosymplectic,
    LagrangianContact,
    SplitContact,
)
from .structures.poisson import (
    Canonical,
    DensityMatrices,
    ExtendedPhaseSpace,
    LiePoisson,
    NoPoisson,
    PoissonMap,
    PoissonStructure,
    PoissonTensor,
)
from .structures.spins import Spins

__all__ = [
    "GL",
    "SE",
    "SL",
    "SO",
    "SPD",
    "SU",
    "AntisymmetryError",
    "Canonical",
    "CanonicalContact",
    "CayleyRetraction",
    "Chart",
    "ClosureError",
    "ComponentError",
    "ContactForm",
    "ContactStructure",
    "Coordinates",
    "Correlation",
    "Cosymplectic",
    "DensityMatrices",
    "DirectSum",
    "DomainError",
    "Euclidean",
    "EuclideanRetraction",
    "ExtendedPhaseSpace",
    "Flag",
    "ForkError",
    "Formula",
    "GeomstatsSpace",
    "Grassmann",
    "GroupRetraction",
    "GroupSpace",
    "Heisenberg",
    "Homogeneous",
    "Hyperbolic",
    "IsomorphismType",
    "JacobiError",
    "LagrangianContact",
    "LevelSet",
    "LieAlgebra",
    "LieAlgebraError",
    "LiePoisson",
    "MagneticExtension",
    "ManifoldsError",
    "MatrixAlgebra",
    "MatrixGroup",
    "MatrixTrace",
    "MidpointRetraction",
    "NoPoisson",
    "NoPolynomialCasimirWarning",
    "Oblique",
    "OffManifoldError",
    "ParameterError",
    "Place",
    "PoissonMap",
    "PoissonStructure",
    "PoissonTensor",
    "PolarRetraction",
    "Polynomial",
    "Power",
    "PrecisionError",
    "Product",
    "ProjectionRetraction",
    "QRRetraction",
    "RepresentationError",
    "Retraction",
    "RiemannianRetraction",
    "ScalarFunction",
    "ShapeError",
    "SizeError",
    "Sp",
    "Space",
    "SpaceError",
    "SpecialEuclidean",
    "SpecialOrthogonal",
    "SpecialUnitary",
    "Sphere",
    "Spins",
    "SplitContact",
    "Stiefel",
    "StiefelCayleyRetraction",
    "TangentBundle",
    "TracePolynomial",
    "abelian",
    "aff",
    "bianchi",
    "coordinates_around",
    "direct_sum",
    "dispersion",
    "frechet_mean",
    "from_geomstats",
    "g2",
    "galilei",
    "gl",
    "heisenberg",
    "magnetic_extension",
    "patera",
    "power",
    "registered",
    "registered_groups",
    "registered_spaces",
    "retraction",
    "se",
    "semidirect_sum",
    "sl",
    "so",
    "sp",
    "spectral",
    "spectral_difference",
    "spectral_trace",
    "su",
    "testing",
    "trilinear_form",
    "u",
]
__dir__ = module_dir_function(__all__)


def __getattr__(name: str):
    if name == "sympy":  # an optional package
        return importlib.import_module(".sympy", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
