"""The step loop of the compiled engine, as a template.

The engine copies everything below the mark into a module of its own for each system, after the scalar programs that
take the place of the stand-ins above it. The rules of the iteration are those of the array engine, in the same words.

A *block* of LANES trajectories advances together, one SIMD lane each; a single trajectory is a block of one lane. All
that a block knows lies in one array w of rows, a number for each lane: ``w[X + i * LANES + l]`` is component i of the
state of lane l. (One array, and offsets that are constants, are what lets the compiler see that lanes do not interact.)
The programs work on the lanes from ``first`` to ``last``.
"""

import numpy as np

from ..array import (
    FIXED_POINT_LIMIT,
    FLOOR,
    HALVINGS,
    NEWTON_LIMIT,
    NEWTON_REUSE,
    NON_FINITE,
    NOT_CONVERGED,
    PLATEAU,
    SHRINKING,
    SLOW,
    VANISHED,
)

IDLE, ITERATING, SOLVED, HARD = 0, 1, 2, 3
"""Phases of a lane within a step."""

N = M = LANES = LENGTH = 1
NEWTON = False
"""Components of the state, of all stage slopes together; trajectories in a block; length of v; whether there are
the programs that only Newton's method needs, ``linearise``, ``along`` and ``sound``."""

X = LOW = K = BEFORE = GUESS = NEW = AFTER = AFTER_LOW = AFTER_ENERGY = AFTER_ENTROPY = CHECK = 0
H = SIZE = UPDATE = SLOPE = PREVIOUS = BEST = STALLED = PHASE = CHANGE = TRIES = CORRECTIONS = 0
STATUS = STEP = FIXED_POINT = NEWTONS = MOST = ENERGY = ENTROPY = RESIDUAL = WORST = 0
HIGHEST = LOWEST = LEAST_RISE = LARGEST_GAIN = INTEGRAL = RELAXING = NOISE = 0
ENERGY_SIZE = ENTROPY_SIZE = AFTER_ENERGY_SIZE = AFTER_ENTROPY_SIZE = 0
"""Offsets of the rows in w. ENTROPY follows ENERGY; RELAXING is the distance to the one whose relaxation is timed."""


def prepare(p, w, first, last):
    """GUESS from K and BEFORE; SIZE, the largest component of the state."""


def iterate(p, w, first, last):
    """NEW, the slopes at GUESS; UPDATE, their largest difference; SLOPE, the largest of them."""


def sound(p, w, first, last):
    """NOISE, the size at which the motion from the state is rounded."""


def linearise(p, w, l, v):
    """What the derivative of NEW by GUESS needs, at the GUESS of lane l, in every direction: v from 2 M on."""


def along(p, w, l, v):
    """The derivative of NEW - GUESS by GUESS in the direction v[:M], as v[M:2 M]."""


def finish(p, w, first, last):
    """AFTER and AFTER_LOW, the state that GUESS leads to, its energy and entropy; CHECK, finite if they all are.

    And the sizes at which energy and entropy are rounded there.
    """


def njit(function):
    return function


entry = njit


# -- the mark: what follows is copied ---------------------------------------------------------------------------------


@njit
def settle(w, made):
    """Judge the iterates of all lanes and accept NEW; the number of lanes that go on."""
    for i in range(0, M * LANES, LANES):
        for l in range(LANES):
            w[GUESS + i + l] = w[NEW + i + l] if w[PHASE + l] == ITERATING else w[GUESS + i + l]
    going = 0
    for l in range(LANES):
        update, previous, best = w[UPDATE + l], w[PREVIOUS + l], w[BEST + l]
        rate = update / previous if made > 1 and previous > 0.0 else 0.0
        stalled = 0.0 if update < SHRINKING * best else w[STALLED + l] + 1.0
        best = update if update < best else best
        scale = w[SIZE + l] / w[H + l] + w[SLOPE + l] + VANISHED
        done = update <= FLOOR * scale or (stalled >= 2.0 and update <= PLATEAU * scale)
        hopeless = not update < np.inf or (made >= 3 and rate > SLOW and best > PLATEAU * scale)
        phase = SOLVED if done else (HARD if hopeless or made == FIXED_POINT_LIMIT else ITERATING)
        keep = w[PHASE + l] == ITERATING
        w[PREVIOUS + l] = update
        w[BEST + l] = best
        w[STALLED + l] = stalled
        w[CHANGE + l] = update if keep else w[CHANGE + l]
        w[TRIES + l] = made if keep else w[TRIES + l]
        w[PHASE + l] = phase if keep else w[PHASE + l]
        going += 1 if keep and phase == ITERATING else 0
    return going


@njit
def factorise(A, order):
    """LU factors of A in its place, rows exchanged as ``order`` says; False where A is singular or not finite."""
    for j in range(M):
        pivot = j
        for i in range(j + 1, M):
            if abs(A[i, j]) > abs(A[pivot, j]):
                pivot = i
        if not (0.0 < abs(A[pivot, j]) < np.inf):
            return False
        order[j] = pivot
        if pivot != j:
            for c in range(M):
                A[j, c], A[pivot, c] = A[pivot, c], A[j, c]
        for i in range(j + 1, M):
            A[i, j] /= A[j, j]
            for c in range(j + 1, M):
                A[i, c] -= A[i, j] * A[j, c]
    return True


@njit
def substitute(A, order, b):
    """The solution of ``A y = b``, in the place of b, from the factors."""
    for i in range(M):
        b[i], b[order[i]] = b[order[i]], b[i]
        for j in range(i):
            b[i] -= A[i, j] * b[j]
    for i in range(M - 1, -1, -1):
        for j in range(i + 1, M):
            b[i] -= A[i, j] * b[j]
        b[i] /= A[i, i]


@njit
def jacobian(p, w, l, matrix, v):
    """The derivative of NEW - GUESS by GUESS, column by column."""
    linearise(p, w, l, v)
    v[:M] = 0.0
    for j in range(M):
        v[j] = 1.0
        along(p, w, l, v)
        v[j] = 0.0
        for i in range(M):
            matrix[i, j] = v[M + i]


@njit
def misfit(p, w, l):
    """``|slopes(k) - k|`` at the GUESS of a lane; UPDATE, the largest component of it."""
    iterate(p, w, l, l + 1)
    total = 0.0
    for i in range(l, M * LANES, LANES):
        total += (w[NEW + i] - w[GUESS + i]) ** 2
    return np.sqrt(total)


@njit
def largest(w, l):
    """``max |GUESS|`` of a lane."""
    size = 0.0
    for i in range(l, M * LANES, LANES):
        size = max(size, abs(w[GUESS + i]))
    return size


@njit
def newton(p, w, l, matrix, order, b, v, damped):
    """Simplified Newton for one lane, with halved steps or without: status, last update, iterations."""
    # From the prediction, or from a step of nothing where that solves the equations better: far out Newton may wander.
    prepare(p, w, l, l + 1)
    predicted = misfit(p, w, l)
    for i in range(l, M * LANES, LANES):
        w[GUESS + i] = 0.0
    found = misfit(p, w, l)
    if predicted <= found:
        prepare(p, w, l, l + 1)
        found = misfit(p, w, l)
    status, update, best, rate, stalled, made, used = NOT_CONVERGED, np.inf, np.inf, 0.0, 0, 0, NEWTON_REUSE
    w[NOISE + l] = 0.0
    while status == NOT_CONVERGED and made < NEWTON_LIMIT:
        if used >= NEWTON_REUSE or rate >= 0.3:
            jacobian(p, w, l, matrix, v)
            if not factorise(matrix, order):
                return NON_FINITE, np.nan, made
            used = 0
        scale = w[SIZE + l] / w[H + l] + largest(w, l) + VANISHED
        previous, update = update, 0.0
        for i in range(M):
            b[i] = w[NEW + i * LANES + l] - w[GUESS + i * LANES + l]
        substitute(matrix, order, b)
        for i in range(M):
            w[GUESS + i * LANES + l] -= b[i]
            update = max(update, abs(b[i]))
        before, found, factor = found, misfit(p, w, l), 1.0
        while damped and not found < before and factor > 0.5**HALVINGS and update > PLATEAU * scale:
            factor, update = 0.5 * factor, 0.5 * update
            for i in range(M):
                w[GUESS + i * LANES + l] += factor * b[i]
            found = misfit(p, w, l)
        made, used = made + 1, used + 1 if factor == 1.0 else NEWTON_REUSE
        rate = update / previous if made > 1 and previous > 0.0 else 0.0
        stalled = 0 if update < SHRINKING * best else stalled + 1
        best = min(best, update)
        scale = w[SIZE + l] / w[H + l] + largest(w, l) + VANISHED
        if not np.isfinite(found + scale):
            status, update = NON_FINITE, np.nan
        elif update <= FLOOR * scale or (stalled >= 2 and update <= PLATEAU * scale):
            status, w[NOISE + l] = 0, 0.0
        elif stalled >= 2:
            if w[NOISE + l] == 0.0:
                sound(p, w, l, l + 1)
            if w[UPDATE + l] <= PLATEAU * w[NOISE + l]:
                status = 0
    return status, update, made


@njit
def solve_by_newton(p, w, l, matrix, order, b, v):
    """Newton's method for one lane: with whole steps, and where that fails with halved ones."""
    status, update, made = newton(p, w, l, matrix, order, b, v, False)
    if status != 0:
        status, update, more = newton(p, w, l, matrix, order, b, v, True)
        made += more
    w[STATUS + l] = status
    w[PHASE + l] = SOLVED if status == 0 else IDLE
    w[CHANGE + l] = update
    w[CORRECTIONS + l] = made
    if status != 0:
        w[RESIDUAL + l] = relative(w, l, update)


@njit
def relative(w, l, update):
    """The residual: an update of the slopes relative to the state, or to the NOISE of the slopes."""
    size = max(w[SIZE + l], w[H + l] * w[NOISE + l])
    return w[H + l] * update / (size if size > 0.0 else 1.0)


@njit
def take_step(p, w, matrix, order, b, v):
    """One step of every lane that is running; where one fails its state stays and a status says why.

    False, and nothing has happened, where some lane needs Newton's method and the module has none.
    """
    prepare(p, w, 0, LANES)
    going = 0
    for l in range(LANES):
        running = w[STATUS + l] == 0.0
        w[PHASE + l] = ITERATING if running else IDLE
        w[PREVIOUS + l] = np.inf
        w[BEST + l] = np.inf
        w[STALLED + l] = 0.0
        w[CORRECTIONS + l] = 0.0
        w[NOISE + l] = 0.0
        going += 1 if running else 0
    made = 0
    while going > 0:
        iterate(p, w, 0, LANES)
        made += 1
        going = settle(w, made)
    hard = 0
    for l in range(LANES):
        hard += 1 if w[PHASE + l] == HARD else 0
    if hard > 0:
        if not NEWTON:
            return False
        for l in range(LANES):
            if w[PHASE + l] == HARD:
                solve_by_newton(p, w, l, matrix, order, b, v)
    finish(p, w, 0, LANES)
    for l in range(LANES):
        solved = w[PHASE + l] == SOLVED
        good = solved and np.isfinite(w[CHECK + l])
        residual = relative(w, l, w[CHANGE + l])
        energy, entropy, relaxing = w[AFTER_ENERGY + l], w[AFTER_ENTROPY + l], w[AFTER_ENERGY + RELAXING + l]
        rise, gain = entropy - w[ENTROPY + l], energy - w[ENERGY + l]
        iterations = w[TRIES + l] + w[CORRECTIONS + l]
        w[INTEGRAL + l] += 0.5 * w[H + l] * (w[ENERGY + RELAXING + l] + relaxing) if good else 0.0
        w[STATUS + l] = NON_FINITE if solved and not good else w[STATUS + l]
        w[PHASE + l] = SOLVED if good else IDLE
        w[RESIDUAL + l] = residual if solved else w[RESIDUAL + l]
        w[STEP + l] += 1.0 if good else 0.0
        w[FIXED_POINT + l] += w[TRIES + l] if good else 0.0
        w[NEWTONS + l] += w[CORRECTIONS + l] if good else 0.0
        w[MOST + l] = iterations if good and iterations > w[MOST + l] else w[MOST + l]
        w[WORST + l] = residual if good and residual > w[WORST + l] else w[WORST + l]
        w[HIGHEST + l] = energy if good and energy > w[HIGHEST + l] else w[HIGHEST + l]
        w[LOWEST + l] = energy if good and energy < w[LOWEST + l] else w[LOWEST + l]
        w[LEAST_RISE + l] = rise if good and rise < w[LEAST_RISE + l] else w[LEAST_RISE + l]
        w[LARGEST_GAIN + l] = gain if good and gain > w[LARGEST_GAIN + l] else w[LARGEST_GAIN + l]
        energy_size, entropy_size = w[AFTER_ENERGY_SIZE + l], w[AFTER_ENTROPY_SIZE + l]
        w[ENERGY_SIZE + l] = energy_size if good and energy_size > w[ENERGY_SIZE + l] else w[ENERGY_SIZE + l]
        w[ENTROPY_SIZE + l] = entropy_size if good and entropy_size > w[ENTROPY_SIZE + l] else w[ENTROPY_SIZE + l]
        w[ENERGY + l] = energy if good else w[ENERGY + l]
        w[ENTROPY + l] = entropy if good else w[ENTROPY + l]
    for i in range(0, N * LANES, LANES):
        for l in range(LANES):
            good = w[PHASE + l] == SOLVED
            w[X + i + l] = w[AFTER + i + l] if good else w[X + i + l]
            w[LOW + i + l] = w[AFTER_LOW + i + l] if good else w[LOW + i + l]
    for i in range(0, M * LANES, LANES):
        for l in range(LANES):
            good = w[PHASE + l] == SOLVED
            w[BEFORE + i + l] = w[K + i + l] if good else w[BEFORE + i + l]
            w[K + i + l] = w[GUESS + i + l] if good else w[K + i + l]
    return True


@entry
def advance(p, blocks, done, saves, every, out, most):
    """Every block from its step ``done`` to step ``saves * every``, each so-manieth state kept, with its energies.

    No further than ``most`` steps, or to where a block needs Newton's method and the module has none: the number of
    that block is returned, and another call, with a module that has, goes on there; otherwise the number of blocks.
    """
    matrix, order, b, v = np.empty((M, M)), np.empty(M, np.int64), np.empty(M), np.empty(LENGTH)
    for block in range(len(blocks)):
        w, end = blocks[block], min(saves * every, done[block] + most)
        while done[block] < end:
            running = 0
            for l in range(LANES):
                running += 1 if w[STATUS + l] == 0.0 else 0
            if running == 0:
                break
            if not take_step(p, w, matrix, order, b, v):
                return block
            done[block] += 1
            if done[block] % every == 0:
                kept = out[block, done[block] // every - 1]
                for i in range(N * LANES):
                    kept[i] = w[X + i]
                for i in range(2 * LANES):
                    kept[N * LANES + i] = w[ENERGY + i]
    return len(blocks)
