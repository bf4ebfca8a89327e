"""Simplified Newton iteration on the stage equations of one trajectory, for the step loop to call.

By the rules of the array engine: whole steps first, then halved ones. What is judged, and what the equations are, are
scalar programs; here are the loops around them and the factorisation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from llvmlite import ir

from ..rules import Rules
from ..stages import Iteration, noise_of
from .loop import NUMBERS, SOLVED, Layout, Piece
from .machine_code import MachineCode
from .writer import NUMBER, WHOLE, Writer

GIVEN = ("dW", "x", "low", "h", "k", "before")
"""What is taken from a block, beside the trajectory's own parameters."""


def newton_pieces(
    both: Callable, driven: Callable, scale: Callable, piece: Callable[..., Piece], rules: Rules
) -> dict[str, Piece]:
    """The programs of Newton's method: see :func:`solver`.

    Parameters
    ----------
    both : function from parameters to a system and a method
    driven : function from parameters and the increments of a step to a system and the method of that step
    scale : function from a state, a step and slopes to what updates of the slopes are measured against
    piece : function from a function, the names of its arguments and of its results
    """

    def fresh(k):
        one = jnp.ones(())
        return k, one * jnp.inf, one * jnp.inf, 0 * one, one * jnp.inf, 0 * one, one * rules.reuse, one, one, 0 * one

    def begin(p, k, before):
        return fresh(both(p)[1].predict(k, before))

    def rest(k):
        return fresh(jnp.zeros_like(k))

    def misfit(p, dW, x, low, h, k):
        system, method = driven(p, dW)
        new = method.slopes(system, x, low, h, k)
        return new, jnp.max(jnp.abs(new - k)), jnp.linalg.norm(new - k)

    def along(p, dW, x, low, h, k, direction):
        system, method = driven(p, dW)
        return method.change(system, x, low, h, k, direction)

    def direct(k, new, used, renew):
        return new - k, jnp.where(renew > 0.0, 0.0, used)

    def moved(k, step, found):
        return k - step, k, found, jnp.ones(()), jnp.max(jnp.abs(step))

    def worse(x, h, k, damped, found, sought, factor, length):
        halve = (damped > 0.0) & (factor > 0.5**rules.halvings) & (length > rules.plateau * scale(x, h, k))
        return jnp.where(halve & ~(found < sought), 1.0, 0.0)

    def halved(k, step, factor, length):
        return k + 0.5 * factor * step, 0.5 * factor, 0.5 * length

    def judge(x, h, k, old, update, best, stalled, previous, made, used, factor, found, missed, noise, regular):
        s = Iteration(old, update, best, stalled, previous, made).after(k, rules)
        size = scale(x, h, k)
        defined = jnp.isfinite(found + size) & (regular > 0.0)
        plain, used = s.settled(size, rules), jnp.where(factor == 1.0, used + 1.0, rules.reuse)
        converged = defined & (plain | s.settled(size, rules, missed, noise))
        goes_on = defined & ~converged & (s.made < rules.newton)
        uncertain = defined & ~converged & (s.stalled >= 2) & (noise == 0.0)
        renew = (used >= rules.reuse) | s.slower(rules.stale)
        return (
            *s[1:],
            used,
            *(jnp.where(t, 1.0, 0.0) for t in (goes_on, renew, converged, defined, uncertain)),
            jnp.where(plain, 0.0, noise),
        )

    def sound(p, x):
        system, method = both(p)
        return noise_of(system, method, x)

    def settle(missed, noise, goes_on):
        settled = missed <= rules.plateau * noise
        return jnp.where(settled, 1.0, 0.0), jnp.where(settled, 0.0, goes_on)

    def count(made, newtons, update, defined):
        return newtons + made, jnp.where(defined > 0.0, update, jnp.nan)

    iteration = "guess update best stalled previous made"
    start = (*iteration.split(), "used", "renew", "goes_on", "noise")
    judged = (*iteration.split()[1:], "used", "goes_on", "renew", "converged", "defined", "uncertain", "noise")
    # of a derivative, what is the same in every direction is computed once a Jacobian
    whole = piece(along, "p dW x low h guess direction", ("changes",))
    first, rest_of_it = whole.program.split([6])
    return {
        "begin": piece(begin, "p k before", start),
        "rest": piece(rest, "k", start),
        "misfit": piece(misfit, "p dW x low h guess", ("new", "missed", "found")),
        "linearise": Piece(first, whole.arguments, ("linear",)),
        "along": Piece(rest_of_it, (*whole.arguments, "linear"), ("changes",)),
        "direct": piece(direct, "guess new used renew", ("direction", "used")),
        "moved": piece(moved, "guess direction found", ("guess", "old", "sought", "factor", "length")),
        "worse": piece(worse, "x h guess damped found sought factor length", ("worse",)),
        "halved": piece(halved, "guess direction factor length", ("guess", "factor", "length")),
        "judge": piece(
            judge, "x h guess old update best stalled previous made used factor found missed noise regular", judged
        ),
        "sound": piece(sound, "p x", ("noise",)),
        "settle": piece(settle, "missed noise goes_on", ("converged", "goes_on")),
        "count": piece(count, "made newtons update defined", ("newtons", "update")),
    }


def solver(
    pieces: Mapping[str, Piece], shapes: Mapping[str, tuple[int, ...]], block: Layout, varies: np.ndarray, lanes: int
) -> MachineCode:
    """The function ``solve(p, block, lane)``, which solves the equations of a lane, as machine code.

    Parameters
    ----------
    pieces : mapping
        ``begin``, a guess from the slopes of the steps before, and ``rest``, a step of size zero; ``misfit``, what the
        equations miss there; ``linearise``, what their derivative needs in every direction, and ``along``, the
        derivative in one; ``moved``, the guess after a step; ``halved``, after half of it is taken back; ``judge`` and,
        with the ``sound`` of the motion, ``settle``, whether it goes on; ``count``, what it took.
    shapes : mapping
        Of the arrays that they read and write.
    block : Layout
    varies : array of bool, shape (p,)
    """
    unknowns = int(np.prod(shapes["guess"]))
    layout = Layout({**shapes, "p": (int(varies.sum()),), "matrix": (unknowns, unknowns), "order": (unknowns,)})
    module = ir.Module("newton")
    for name, piece in pieces.items():
        _Piece(module, name, layout, varies).write_piece(piece)
    _Solve(module, layout, block, lanes, unknowns).write_loops()
    return MachineCode(module)


class _Piece(Writer):
    """Writes a piece as a function ``f(p, s)`` of arrays that lie one after another in s."""

    def __init__(self, module: ir.Module, name: str, layout: Layout, varies: np.ndarray):
        function = ir.Function(module, ir.FunctionType(ir.VoidType(), [NUMBERS, NUMBERS]), name)
        function.linkage = "internal"
        super().__init__(ir.IRBuilder(function.append_basic_block()), 1)
        self.p, self.s = function.args
        self.layout, self.varies, self.own = layout, varies, np.cumsum(varies) - 1

    def write_piece(self, piece: Piece) -> None:
        build, rows = self.builder, self.layout.rows

        def at(base: ir.Value, place: int) -> ir.Value:
            return build.gep(base, [self.whole_number(int(place))])

        def read(i: int, j: int) -> ir.Value:
            name = piece.arguments[i]
            if name != "p":
                return build.load(at(self.s, rows[name] + j))
            return build.load(at(self.s, rows["p"] + self.own[j]) if self.varies[j] else at(self.p, j))

        for name, values in zip(piece.results, self.write(piece.program, read), strict=True):
            for j, value in enumerate(values):
                build.store(value, at(self.s, rows[name] + j))
        build.ret_void()


class _Solve(Writer):
    """Writes ``solve(p, block, lane)``."""

    def __init__(self, module: ir.Module, layout: Layout, block: Layout, lanes: int, unknowns: int):
        function = ir.Function(module, ir.FunctionType(ir.VoidType(), [NUMBERS, NUMBERS, WHOLE]), "solve")
        super().__init__(ir.IRBuilder(function.append_basic_block()), 1)
        self.p, self.w, self.lane = function.args
        self.module, self.layout, self.block, self.all, self.unknowns = module, layout, block, lanes, unknowns
        self.s = self.builder.alloca(NUMBER, layout.height)

    def write_loops(self) -> None:
        build = self.builder
        with self.counted(self.whole_number(self.layout.height)) as i:
            build.store(self.constant(0.0), build.gep(self.s, [i]))
        self._exchange(("p", *GIVEN), out=False)
        with self.counted(self.whole_number(2)) as attempt, build.if_then(self._is("converged", "!=", 1.0)):
            build.store(build.sitofp(attempt, NUMBER), self._array("damped"))
            self._attempt()
        self._exchange(SOLVED, out=True)
        build.ret_void()

    def _attempt(self) -> None:
        """Newton's method with whole steps, or with halved ones."""
        build = self.builder
        # From the prediction, or from a step of size zero where that solves the equations better: far out Newton may
        # wander.
        self._call("begin", "misfit")
        predicted = build.load(self._array("found"))
        self._call("rest", "misfit")
        with build.if_then(build.fcmp_ordered("<=", predicted, build.load(self._array("found")))):
            self._call("begin", "misfit")
        with self.repeated(lambda: self._is("goes_on", "==", 1.0)):
            with build.if_then(self._is("renew", "==", 1.0)):
                self._factorise()
            self._call("direct")
            self._substitute(self._array("direction"))
            self._call("moved", "misfit")
            with self.repeated(lambda: self._holds("worse")):
                self._call("halved", "misfit")
            self._call("judge")
            with build.if_then(self._is("uncertain", "==", 1.0)):
                self._call("sound", "settle")
        self._call("count")

    def _factorise(self) -> None:
        """The Jacobian matrix column by column, and its LU factors in its place; ``goes_on`` is 0 where it has none."""
        build, m, matrix = self.builder, self.whole_number(self.unknowns), self._array("matrix")
        direction, changes, order = (self._array(name) for name in ("direction", "changes", "order"))

        def entry(i, j):
            return build.gep(matrix, [build.add(build.mul(i, m), j)])

        def size(i, j):
            return self.operation("abs", [build.load(entry(i, j))])

        self._call("linearise")
        with self.counted(m) as j:
            build.store(self.constant(0.0), build.gep(direction, [j]))
        with self.counted(m) as j:
            build.store(self.constant(1.0), build.gep(direction, [j]))
            self._call("along")
            build.store(self.constant(0.0), build.gep(direction, [j]))
            with self.counted(m) as i:
                build.store(build.load(build.gep(changes, [i])), entry(i, j))
        build.store(self.constant(1.0), self._array("regular"))
        with build.goto_entry_block():
            pivot = build.alloca(WHOLE)
        with self.counted(m) as j:
            below = build.sub(m, j)
            build.store(j, pivot)
            with self.counted(below) as n:
                i = build.add(j, n)
                larger = build.fcmp_ordered(">", size(i, j), size(build.load(pivot), j))
                build.store(build.select(larger, i, build.load(pivot)), pivot)
            chosen = build.load(pivot)
            build.store(build.sitofp(chosen, NUMBER), build.gep(order, [j]))
            largest = size(chosen, j)
            usable = build.and_(
                build.fcmp_ordered("<", self.constant(0.0), largest),
                build.fcmp_ordered("<", largest, self.constant(np.inf)),
            )
            regular = build.select(usable, build.load(self._array("regular")), self.constant(0.0))
            build.store(regular, self._array("regular"))
            with self.counted(m) as c:
                one, other = build.load(entry(j, c)), build.load(entry(chosen, c))
                build.store(other, entry(j, c))
                build.store(one, entry(chosen, c))
            with self.counted(build.sub(below, self.whole_number(1))) as n:
                i = build.add(build.add(j, n), self.whole_number(1))
                factor = build.fdiv(build.load(entry(i, j)), build.load(entry(j, j)))
                build.store(factor, entry(i, j))
                with self.counted(build.sub(below, self.whole_number(1))) as l:
                    c = build.add(build.add(j, l), self.whole_number(1))
                    build.store(
                        build.fsub(build.load(entry(i, c)), build.fmul(factor, build.load(entry(j, c)))), entry(i, c)
                    )

    def _substitute(self, b: ir.Value) -> None:
        """Replace b by the solution of ``A y = b``, from the factors."""
        build, m, matrix, order = (
            self.builder,
            self.whole_number(self.unknowns),
            self._array("matrix"),
            self._array("order"),
        )

        def entry(i, j):
            return build.load(build.gep(matrix, [build.add(build.mul(i, m), j)]))

        def subtract(i, j):
            place = build.gep(b, [i])
            build.store(build.fsub(build.load(place), build.fmul(entry(i, j), build.load(build.gep(b, [j])))), place)

        with self.counted(m) as i:
            own = build.gep(b, [i])
            other = build.gep(b, [build.fptosi(build.load(build.gep(order, [i])), WHOLE)])
            one, two = build.load(own), build.load(other)
            build.store(two, own)
            build.store(one, other)
        with self.counted(m) as i, self.counted(i) as j:
            subtract(i, j)
        with self.counted(m) as n:
            i = build.sub(build.sub(m, self.whole_number(1)), n)
            with self.counted(n) as l:
                subtract(i, build.add(build.add(i, l), self.whole_number(1)))
            place = build.gep(b, [i])
            build.store(build.fdiv(build.load(place), entry(i, i)), place)

    # -- arrays -------------------------------------------------------------------------------------------------------

    def _call(self, *names: str) -> None:
        for name in names:
            self.builder.call(self.module.globals[name], [self.p, self.s])

    def _array(self, name: str) -> ir.Value:
        return self.builder.gep(self.s, [self.whole_number(self.layout.rows[name])])

    def _is(self, name: str, relation: str, number: float) -> ir.Value:
        compare = self.builder.fcmp_unordered if relation == "!=" else self.builder.fcmp_ordered
        return compare(relation, self.builder.load(self._array(name)), self.constant(number))

    def _holds(self, name: str) -> ir.Value:
        """Whether a piece, asked anew, finds that what it is named after is so."""
        self._call(name)
        return self._is(name, "==", 1.0)

    def _exchange(self, names: Sequence[str], out: bool) -> None:
        """Arrays between the block and s."""
        build = self.builder
        for name in names:
            if not self.layout.sizes[name]:
                continue
            with self.counted(self.whole_number(self.layout.sizes[name])) as i:
                row = build.mul(build.add(self.whole_number(self.block.rows[name]), i), self.whole_number(self.all))
                there, here = build.gep(self.w, [build.add(row, self.lane)]), build.gep(self._array(name), [i])
                build.store(build.load(here if out else there), there if out else here)
