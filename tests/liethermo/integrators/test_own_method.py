"""Methods of users: what their classes state and return is checked before a run."""

import pytest

import liethermo as lt

BODY = lt.models.rigid_body(rate=0.2)
X0 = [0.1, 0.2, 1.0]


class Midpoint(lt.OneStepMethod):
    """The midpoint rule with a discrete gradient of the energy, as in the guide."""

    stages = 1
    order = 2
    preserves = frozenset({"energy"})

    def slopes(self, system, x, compensation, h, k):
        d = h * k[0]
        middle = x + (compensation + 0.5 * d)
        dH = lt.Gonzalez()(system.energy, x, d, compensation)
        return system.field(middle, dH, system.entropy.gradient(middle), ())[None]

    def increment(self, h, k):
        return h * k[0]


class MisspeltGuarantee(Midpoint):
    preserves = frozenset({"energie"})


class FlatSlopes(Midpoint):
    def slopes(self, *arguments):
        return super().slopes(*arguments)[0]


class StackedIncrement(Midpoint):
    def increment(self, h, k):
        return h * k


class Branching(Midpoint):
    def slopes(self, system, x, compensation, h, k):
        if x[0] > 0.0:
            h = -h
        return super().slopes(system, x, compensation, h, k)


class MissingReturn(Midpoint):
    def increment(self, h, k):
        pass


def test_a_method_of_the_guide_runs_in_every_engine():
    for engine in ("array", "compiled"):
        run = lt.integrate(BODY, X0, (0.0, 2.0), 0.1, Midpoint(), engine=engine)
        assert run.audit().energy_drift < 1e-14


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (MisspeltGuarantee, "preserves of MisspeltGuarantee has 'energie'; a method may preserve 'energy'"),
        (FlatSlopes, r"slopes of FlatSlopes must return an array of shape \(1, 3\), got \(3,\)"),
        (StackedIncrement, r"increment of StackedIncrement must return an array of shape \(3,\), got \(1, 3\)"),
        (Branching, r"slopes of Branching could not be traced: .*`if`.*test_own_method.py:\d+, in slopes"),
        (MissingReturn, "increment of MissingReturn must return an array .* got NoneType"),
    ],
)
def test_what_a_method_states_and_returns_is_checked(method, message):
    with pytest.raises((lt.InputError, lt.FunctionError), match=message):
        lt.integrate(BODY, X0, (0.0, 1.0), 0.1, method())
