"""Checks the Python in code font: its names exist, its calls fit their signatures, and what is complete is executed."""

from __future__ import annotations

import ast
import builtins
import functools
import importlib
import inspect
import re
import sys
import typing
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pydantic

import liethermo
import manifolds

PACKAGES = {"lt": liethermo, "liethermo": liethermo, "mf": manifolds, "manifolds": manifolds}
OTHERS = {"np": "numpy", "jnp": "jax.numpy", "lax": "jax.lax", "jax": "jax", "xarray": "xarray", "equinox": "equinox"}
NOT_PYTHON = re.compile(
    r"-|(liethermo|make|pip|python) |[\w.-]+(/[\w.-]*)+$|[\w-]*\.(md|cff|png|pdf|svg|toml|nc|zarr)$"
)
"""Options, command lines, paths and names of files."""

FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"(?<![`}])`([^`\n]+)`(?!`)")
FOREIGN = re.compile(r"^\|[^|\n]*\| liethermo \|\n(?:\|.*\n)+", re.MULTILINE)
"""A table whose first column has the words of another package."""


class SpanError(ValueError):
    """A piece of Python in code font that would not run."""


def spans(page: str) -> list[str]:
    """What a page has in code font outside of its blocks and roles, but for the words of other packages."""
    ours = FOREIGN.sub(lambda table: re.sub(r"^\|[^|\n]*\|", "|", table[0], flags=re.MULTILINE), FENCE.sub("", page))
    return SPAN.findall(ours)


def check(span: str, bound: frozenset[str] = frozenset()) -> bool:
    """Whether a span in code font is Python; that which is has to fit the packages.

    Every name of the packages has to exist, every argument to be one of the callable that it is given to, and a bare
    ``name=value`` one of any callable. Words in lower case that nobody knows stand for values. An expression without
    such words is executed.

    Parameters
    ----------
    bound : names that the blocks of the page define

    Raises
    ------
    SpanError
    """
    tree = parsed(span)
    if tree is None:
        return False
    statement = tree.body[0]
    name = ast.unparse(statement.targets[0]) if isinstance(statement, ast.Assign) else None
    if name is not None and name not in parameters():
        raise SpanError(f"no public function has an argument {name!r}")
    checker = _Checker(bound)
    checker.visit(statement)
    if checker.complete:
        try:
            value = eval(compile(ast.Expression(statement.value), span, "eval"), checker.known)
        except Exception as error:
            raise SpanError(f"{type(error).__name__}: {error}") from error
        annotations = [] if name is None else parameters()[name]
        if annotations and not any(accepts(annotation, value) for annotation in annotations):
            raise SpanError(f"no public function takes such a value as {name!r}")
    return True


def check_block(code: str) -> None:
    """A block that cannot run where pages are built, such as one that needs a cluster: its names and its calls.

    Raises
    ------
    SpanError
    """
    bound = names_of(code)
    _Checker(bound, foreign=bound).visit(ast.parse(code))


def parsed(span: str) -> ast.Module | None:
    """The one statement of a span; ``key=`` and ``f(a, k=1, ...)`` leave values out. None where it is no Python."""
    if NOT_PYTHON.match(span):
        return None
    text = re.sub(r",\s*\.\.\.\s*\)", ", *_)", span + "..." if re.fullmatch(r"\w+=", span) else span)
    try:
        tree = ast.parse(f"_{text}" if text.startswith(".") else text)
    except SyntaxError:
        return None
    return tree if len(tree.body) == 1 and isinstance(tree.body[0], ast.Assign | ast.Expr) else None


def names_of(blocks: str) -> frozenset[str]:
    """What the blocks of a page define, the arguments of their functions too; not the packages that they import."""
    found = set()
    for node in ast.walk(ast.parse(blocks)):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names = {(alias.asname or alias.name).partition(".")[0] for alias in node.names}
            found |= names - {*PACKAGES, *OTHERS}
        elif isinstance(node, ast.arg):
            found.add(node.arg)
    return frozenset(found)


class _Checker(ast.NodeVisitor):
    """Visits an expression, or the statements of a block.

    Attributes
    ----------
    foreign : frozenset of str
        Words for values of other packages, whose attributes are not known.
    complete : bool
        Whether all of it is known, so that it can be evaluated with the names in ``known``.
    """

    def __init__(self, bound: frozenset[str], foreign: frozenset[str] = frozenset()):
        self.bound, self.foreign, self.complete, self.known = bound, foreign, True, {}

    def visit_Name(self, node: ast.Name) -> None:
        if isinstance(node.ctx, ast.Store):
            return
        found = None if node.id in self.bound else known(node.id)
        if found is None:
            self.complete = False
            if re.match(r"[A-Z]\w*[a-z]", node.id) and node.id not in self.bound | {cls.__name__ for cls in classes()}:
                raise SpanError(f"there is no {node.id!r}")
        else:
            self.known[node.id] = found

    def visit_Constant(self, node: ast.Constant) -> None:
        self.complete &= node.value is not ...

    def visit_Starred(self, node: ast.Starred) -> None:
        self.complete = False

    def visit_Lambda(self, node: ast.Lambda) -> None:
        arguments = frozenset(a.arg for a in node.args.args)
        inner = _Checker(self.bound | arguments, self.foreign)
        inner.visit(node.body)
        self.complete = False

    def visit_Attribute(self, node: ast.Attribute) -> None:
        self.visit(node.value)
        self.find(node)

    def find(self, node: ast.expr) -> Any:
        """The object that a name or a chain of attributes means; None where its first word stands for a value."""
        if isinstance(node, ast.Name):
            return None if node.id in self.bound else known(node.id)
        if not isinstance(node, ast.Attribute):
            return None
        owner = self.find(node.value)
        if owner is None and ast.unparse(node).partition(".")[0] in self.foreign:
            return None
        if owner is None:  # an attribute of a value
            if not any(node.attr in attributes(cls) for cls in classes_of(node.value)):
                raise SpanError(f"{ast.unparse(node.value)!r} has no attribute {node.attr!r}")
            return None
        if not hasattr(owner, node.attr) and node.attr not in fields(owner):
            raise SpanError(f"{ast.unparse(node.value)} has no {node.attr!r}")
        return getattr(owner, node.attr, None)

    def visit_Call(self, node: ast.Call) -> None:
        self.generic_visit(node)
        self.complete &= ast.unparse(node.func).partition(".")[0] not in OTHERS
        found = self.find(node.func)
        if found is not None:
            candidates = [found]
        elif isinstance(node.func, ast.Name) and node.func.id not in self.bound:
            candidates = methods(node.func.id) + functions(node.func.id) + instances(node.func.id)
            if not candidates:
                raise SpanError(f"there is no function or method {node.func.id!r}")
        elif isinstance(node.func, ast.Attribute):
            candidates = methods(node.func.attr, classes_of(node.func.value))
        else:
            return
        fits = [outcome for candidate in candidates if (outcome := fit(candidate, node)) is not None]
        if candidates and not any(isinstance(outcome, bool) for outcome in fits):
            raise SpanError(f"{ast.unparse(node.func)}: {fits[0]}")
        self.complete &= True in fits


def fit(function: Callable, call: ast.Call) -> bool | str:
    """Whether the arguments of a call are all that a function needs, or why they do not fit."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return False
    left_out = any(isinstance(a, ast.Starred) or (isinstance(a, ast.Constant) and a.value is ...) for a in call.args)
    positional = [] if left_out else call.args
    named = {keyword.arg: keyword.value for keyword in call.keywords if keyword.arg}
    try:
        signature.bind_partial(*positional, **named)
    except TypeError as error:
        return str(error)
    try:
        signature.bind(*positional, **named)
    except TypeError:
        return False
    return not left_out


def known(name: str) -> Any:
    """A package, another module, or a public object, by the name that pages call it by; None where it is none."""
    if name in PACKAGES:
        return PACKAGES[name]
    if name in OTHERS:
        return importlib.import_module(OTHERS[name])
    for package in (liethermo, manifolds):
        if name in package.__all__ and not hasattr(builtins, name):
            return getattr(package, name)
    return None if name == "_" else getattr(builtins, name, None)  # doctest leaves its last value as `_`


@functools.cache
def modules() -> tuple[Any, ...]:
    """Those of both packages that are loaded."""
    return tuple(module for name, module in sorted(sys.modules.items()) if name.partition(".")[0] in PACKAGES)


@functools.cache
def classes() -> tuple[type, ...]:
    found = {value: None for module in modules() for value in vars(module).values() if inspect.isclass(value)}
    return tuple(cls for cls in found if cls.__module__.partition(".")[0] in PACKAGES)


def fields(owner: Any) -> set[str]:
    """The attributes that a class declares without a value."""
    bases = owner.__mro__ if inspect.isclass(owner) else ()
    return {name for base in bases for name in getattr(base, "__annotations__", ())}


def all_names(owner) -> list[str]:
    """Return all names of a module or a class, those that ``dir`` leaves out included."""
    return dir(owner) if inspect.ismodule(owner) else list(type.__dir__(owner))


@functools.cache
def attributes(cls: type) -> frozenset[str]:
    """Of the class, those that it declares without a value, and those that its constructor sets."""
    code = getattr(cls.__init__, "__code__", None)
    return frozenset({*all_names(cls), *fields(cls), *(code.co_names if code is not None else ())})


def classes_of(value: ast.expr) -> list[type]:
    """What a value in a span may be: ``solution`` a Solution, another word of any class, or an array."""
    public = (*vars(liethermo).values(), *vars(manifolds).values())
    named = [c for c in public if inspect.isclass(c) and c.__name__.lower() == ast.unparse(value)]
    if named:
        return [cls for cls in classes() if issubclass(cls, tuple(named))]
    return [np.ndarray, *classes()]


def methods(name: str, owners: Sequence[type] | None = None) -> list[Callable]:
    """Methods of this name, without their first argument."""
    owners = classes() if owners is None else owners
    return [_of_instance(cls, name) for cls in owners if callable(getattr(cls, name, None))]


def functions(name: str) -> list[Callable]:
    return [vars(module)[name] for module in modules() if inspect.isfunction(vars(module).get(name))]


def instances(name: str) -> list[Callable]:
    """The call of an instance of a class of this name: ``solution(t)``."""
    return [
        _of_instance(cls, "__call__")
        for cls in classes()
        if cls.__name__.lower() == name and "__call__" in all_names(cls)
    ]


def _of_instance(cls: type, name: str) -> Callable:
    found = getattr(cls, name)
    bound = isinstance(inspect.getattr_static(cls, name), staticmethod | classmethod)
    return found if bound else functools.partial(found, None)


@functools.cache
def parameters() -> dict[str, list[Any]]:
    """The arguments of all that is public, functions, constructors and methods, with the annotations they have."""
    found: dict[str, list[Any]] = {}
    for package in (liethermo, manifolds):
        for owner in (package, *(getattr(package, name) for name in package.__all__)):
            has_members = inspect.ismodule(owner) or inspect.isclass(owner)
            public_names = [name for name in all_names(owner) if not name.startswith("_")] if has_members else []
            # enumerations have names that their members alone can look up
            members = [getattr(owner, name, None) for name in public_names]
            for member in filter(callable, (owner, *members)):
                try:
                    names = inspect.signature(member).parameters
                except (TypeError, ValueError):
                    continue
                hints = annotations_of(member)
                for name in names:
                    found.setdefault(name, []).extend([hints[name]] if name in hints else [])
    return found


def annotations_of(function: Callable) -> dict[str, Any]:
    """Those that can be looked up."""
    try:
        return typing.get_type_hints(function.__init__ if inspect.isclass(function) else function)  # type: ignore[misc]
    except (NameError, TypeError):
        return {}


def accepts(annotation: Any, value: Any) -> bool:
    try:
        adapter = pydantic.TypeAdapter(annotation, config={"arbitrary_types_allowed": True})
    except pydantic.PydanticUserError:  # a dataclass, which has a configuration of its own
        adapter = pydantic.TypeAdapter(annotation)
    try:
        adapter.validate_python(value)
    except pydantic.ValidationError:
        return False
    return True
