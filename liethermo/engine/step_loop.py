"""The step loop of the compiled engine, as a template.

The engine copies everything below the mark into a module of its own for each system, after the scalar programs that
take the place of the stand-ins above it. The rules of the iteration are those of the array engine, in the same words.
"""

import numpy as np

from .array import (
    FIXED_POINT_LIMIT,
    FLOOR,
    NEWTON_LIMIT,
    NEWTON_REUSE,
    NON_FINITE,
    NOT_CONVERGED,
    PLATEAU,
    SHRINKING,
    SLOW,
)

N = M = 0
"""Components of the state, and of all stage slopes together."""

NEWTON = False
"""Whether the module has a Jacobian; one without is smaller, and reports NEEDS_NEWTON where it would want it."""

NEEDS_NEWTON = 3


def predict(k, before, out):
    raise NotImplementedError


def slopes(p, x, low, h, k, out):
    raise NotImplementedError


def jacobian(p, x, low, h, k, out):
    raise NotImplementedError


def increment(h, k, out):
    raise NotImplementedError


def values(p, x, out):
    raise NotImplementedError


def njit(function):
    return function


# -- the mark: what follows is copied ---------------------------------------------------------------------------------


@njit
def residual_size(p, x, low, h, k, new):
    """``|slopes(k) - k|``; new receives the slopes."""
    slopes(p, x, low, h, k, new)
    total = 0.0
    for i in range(M):
        total += (new[i] - k[i]) ** 2
    return np.sqrt(total)


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
def solve_by_newton(p, x, low, h, k, new, largest, matrix, order):
    """Simplified Newton from k, in place; returns status, iterations and last update."""
    update, best, rate, stalled, made, used = np.inf, np.inf, 0.0, 0, 0, NEWTON_REUSE
    while made < NEWTON_LIMIT:
        if used >= NEWTON_REUSE or rate >= 0.3:
            jacobian(p, x, low, h, k, matrix)
            if not factorise(matrix, order):
                return NON_FINITE, made, np.nan
            used = 0
        slopes(p, x, low, h, k, new)
        for i in range(M):
            new[i] -= k[i]
        substitute(matrix, order, new)
        previous, update, size, total = update, 0.0, 0.0, 0.0
        for i in range(M):
            update = max(update, abs(new[i]))
            total += new[i]
            k[i] -= new[i]
            size = max(size, abs(k[i]))
        made, used = made + 1, used + 1
        if not np.isfinite(total):
            return NON_FINITE, made, np.nan
        rate = update / previous if made > 1 and previous > 0.0 else 0.0
        stalled = 0 if update < SHRINKING * best else stalled + 1
        best = min(best, update)
        scale = largest / h + size
        if update <= FLOOR * scale or (stalled >= 2 and update <= PLATEAU * scale):
            return 0, made, update
    return NOT_CONVERGED, made, update


@njit
def take_step(p, h, x, low, k, before, counts, reals, guess, new, d, pair, matrix, order):
    """One step in place; where it fails nothing changes but the status, which is returned, and the residual."""
    largest = 0.0
    for i in range(N):
        largest = max(largest, abs(x[i]))
    predict(k, before, guess)
    update, best, stalled, made, done = np.inf, np.inf, 0, 0, False
    while made < FIXED_POINT_LIMIT:
        slopes(p, x, low, h, guess, new)
        previous, update, size, total = update, 0.0, 0.0, 0.0
        for i in range(M):
            change = abs(new[i] - guess[i])
            update = max(update, change)
            total += change
            size = max(size, abs(new[i]))
            guess[i] = new[i]
        finite = np.isfinite(total)
        made += 1
        rate = update / previous if made > 1 and previous > 0.0 else 0.0
        stalled = 0 if update < SHRINKING * best else stalled + 1
        best = min(best, update)
        scale = largest / h + size
        if finite and (update <= FLOOR * scale or (stalled >= 2 and update <= PLATEAU * scale)):
            done = True
            break
        if not finite or (made >= 3 and rate > SLOW and best > PLATEAU * scale):
            break
    corrections = 0
    if not done:
        if not NEWTON:
            return NEEDS_NEWTON
        # The prediction, or a step of nothing where that solves the equations better: far out Newton may wander.
        predict(k, before, guess)
        predicted = residual_size(p, x, low, h, guess, new)
        for i in range(M):
            new[i] = 0.0
        nothing = residual_size(p, x, low, h, new.copy(), new)
        if not predicted <= nothing:
            for i in range(M):
                guess[i] = 0.0
        status, corrections, update = solve_by_newton(p, x, low, h, guess, new, largest, matrix, order)
        if status != 0:
            reals[2] = h * update / (largest if largest > 0.0 else 1.0)
            return status
    increment(h, guess, d)
    for i in range(N):  # x + low is the state; add the increment with its rounding error caught (Neumaier's two-sum)
        d[i] += low[i]
        pair[i] = x[i] + d[i]
    values(p, pair, pair[N:])
    total = pair[N] + pair[N + 1]
    for i in range(N):
        total += pair[i]
    if not np.isfinite(total):
        reals[2] = h * update / (largest if largest > 0.0 else 1.0)
        return NON_FINITE
    for i in range(N):
        back = pair[i] - x[i]
        low[i] = (x[i] - (pair[i] - back)) + (d[i] - back)
        x[i] = pair[i]
    for i in range(M):
        before[i] = k[i]
        k[i] = guess[i]
    energy, entropy = pair[N], pair[N + 1]
    counts[1] += 1
    counts[2] += made
    counts[3] += corrections
    counts[4] = max(counts[4], made + corrections)
    reals[2] = h * update / (largest if largest > 0.0 else 1.0)
    reals[3] = max(reals[3], reals[2])
    reals[4] = max(reals[4], energy)
    reals[5] = min(reals[5], energy)
    reals[6] = min(reals[6], entropy - reals[1])
    reals[7] = max(reals[7], energy - reals[0])
    reals[0] = energy
    reals[1] = entropy
    return 0


@njit
def advance(p, h, origin, saves, every, x, low, k, before, counts, reals, out):
    """From wherever ``counts`` says up to step ``origin + saves * every``, keeping every so-manieth state in out.

    Where a step fails its status is left in ``counts[0]``, and another call may go on from there.
    """
    guess, new, d, pair = np.empty(M), np.empty(M), np.empty(N), np.empty(N + 2)
    matrix, order = np.empty((M, M)), np.empty(M, np.int64)
    while counts[1] < origin + saves * every:
        counts[0] = take_step(p, h, x, low, k, before, counts, reals, guess, new, d, pair, matrix, order)
        if counts[0] != 0:
            return
        done = counts[1] - origin
        if done % every == 0:
            for i in range(N):
                out[done // every - 1, i] = x[i]
