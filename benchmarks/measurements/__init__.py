"""The measurements, by name, in the order of the page."""

NAMES = (
    "single_body",
    "isolated_body",
    "general",
    "functions",
    "variational",
    "spin",
    "manifolds",
    "fluids",
    "quantum",
    "ensemble",
    "others",
    "tumbling",
    "work_precision",
    "dimension",
    "bodies",
    "network",
    "lattice",
    "first_run",
    "memory",
    "studies",
)
