"""Allow attribute lookups by a string with a silent default only for attributes that other packages define.

If a member of one of our classes were looked up in this way, renaming it would go unnoticed: the entropy of a quantum
system once lost its floor so. Our members exist, or the type says that they do not.
"""

import ast
import pathlib

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]

FOREIGN = {
    "__name__": "of a user's function; classes and partial functions have none",
    "__qualname__": "of a user's function",
    "__module__": "of a user's function",
    "__file__": "of a module; built-in ones have none",
    "__closure__": "of a function of JAX; built-in ones have none",
    "__array__": "of any array",
    "terminal": "of an event, as SciPy reads it",
    "direction": "of an event, as SciPy reads it; of a term of diffrax, which wraps others",
    "term": "of a term of diffrax, which wraps others",
    "dtype": "of an abstract value of JAX; tokens have none",
    "weak_type": "of an array of JAX; those of NumPy have none",
    "shape": "of what a user's function returns",
    "val": "of a parameter of a rule of JAX",
    "debug_info": "of a program that an equation of JAX calls; other parameters have none",
    "func_filename": "of the debug information of JAX, which may be None",
    "frames": "of a traceback of JAX, which may be None",
    "name": "of axes of matplotlib; of a group, in a message about another one",
    "model_fields": "of a model of pydantic; typed dictionaries have none",
    "metric": "of a manifold of geomstats",
    "submersion": "of a manifold of geomstats",
    "geteuid": "of the operating system",
    "sched_getaffinity": "of the operating system",
    "register_at_fork": "of the operating system",
    "O_NOFOLLOW": "of the operating system",
    "O_NONBLOCK": "of the operating system",
    "O_CLOEXEC": "of the operating system",
}

OURS = {
    ("liethermo/learn/files.py", "training"): "what a fit has put beside a system",
    ("liethermo/functions/flat_states.py", "dim"): "of a Casimir, which may be any function that knows its dimension",
}


def lookups():
    """Yield the file, the line and the name of each lookup with a silent default."""
    for package in ("liethermo", "manifolds"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
                    continue
                silent = node.func.id == "hasattr" or (node.func.id == "getattr" and len(node.args) == 3)
                if silent and isinstance(node.args[1], ast.Constant):
                    yield str(path.relative_to(ROOT)), node.lineno, node.args[1].value


def test_no_member_of_ours_is_looked_up_with_a_silent_default():
    unknown = [lookup for lookup in lookups() if lookup[2] not in FOREIGN and (lookup[0], lookup[2]) not in OURS]
    assert not unknown, unknown


@pytest.mark.parametrize("excused_lookup", OURS)
def test_what_is_excused_is_still_there(excused_lookup):
    assert excused_lookup in {(file, name) for file, _, name in lookups()}
