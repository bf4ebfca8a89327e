"""Units by name: their factors, their dimensions, and the names that are refused."""

import numpy as np
import pytest

import liethermo as lt
from liethermo.units import parse_unit, quantity_in_si, split_label

FACTORS = {
    "ms": 1e-3,
    "µs": 1e-6,
    "min": 60.0,
    "degrees": np.pi / 180.0,
    "deg/s": np.pi / 180.0,
    "deg / s": np.pi / 180.0,
    "°/s": np.pi / 180.0,
    "dps": np.pi / 180.0,
    "mdeg/s": np.pi / 180e3,
    "rpm": np.pi / 30.0,
    "RPM": np.pi / 30.0,
    "Degrees/Second": np.pi / 180.0,
    "Kelvin": 1.0,
    "MPa": 1e6,
    "kHz": 1e3,
    "rev/min": np.pi / 30.0,
    "rad s-1": 1.0,
    "m/s^2": 1.0,
    "m s**-2": 1.0,
    "mm/s²": 1e-3,
    "kg m^2/s": 1.0,
    "g cm^2": 1e-7,
    "g0": 9.80665,
    "kJ/K": 1e3,
    "1/s": 1.0,
    "": 1.0,
}


@pytest.mark.parametrize("name", FACTORS)
def test_the_factor_of_a_unit(name):
    assert parse_unit(name).factor == pytest.approx(FACTORS[name], rel=1e-15)


def test_dimensions_of_equal_quantities_are_equal():
    assert parse_unit("N m").dimension == parse_unit("J").dimension == parse_unit("kg m2 s-2").dimension
    assert parse_unit("rpm").dimension == parse_unit("deg/s").dimension
    assert parse_unit("ms").dimension != parse_unit("Hz").dimension


def test_temperatures_have_an_offset():
    np.testing.assert_allclose(parse_unit("°C").to_si([0.0, 100.0]), [273.15, 373.15], rtol=1e-15)
    np.testing.assert_allclose(parse_unit("degF").to_si([32.0, 212.0]), [273.15, 373.15], rtol=1e-15)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("furlong", "unknown unit 'furlong'. Known are"),
        ("deg/sek", "unknown unit 'deg/sek'. Did you mean 's"),
        ("degC/min", "unknown unit 'degC/min'"),
        ("C", "unknown unit 'C'. Did you mean 'degC'"),
        ("m//s", "unknown unit 'm//s'"),
        ("3 m", "unknown unit '3 m'"),
    ],
)
def test_a_unit_that_is_not_known_is_refused_by_name(name, words):
    with pytest.raises(lt.InputError) as raised:
        parse_unit(name)
    assert words in str(raised.value)


@pytest.mark.parametrize(
    ("label", "parts"),
    [
        ("omega_x [deg/s]", ("omega_x", "deg/s")),
        ("Gyroscope x (rad/s)", ("Gyroscope x", "rad/s")),
        ("t(ms)", ("t", "ms")),
        ("x[0]", ("x[0]", "")),
        ("x[0] [mm]", ("x[0]", "mm")),
        ("x[1, 2]", ("x[1, 2]", "")),
        (" time ", ("time", "")),
    ],
)
def test_a_label_is_a_name_with_a_unit(label, parts):
    assert split_label(label) == parts


@pytest.mark.parametrize(
    ("text", "value"),
    [("0.5 deg/s", np.pi / 360.0), ("5e-1deg/s", np.pi / 360.0), ("3 ms", 3e-3), ("2 degC", 2.0), (".5 kg m^2/s", 0.5)],
)
def test_a_number_with_a_unit(text, value):
    assert quantity_in_si(text) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "words"), [("deg", "not a number with a unit"), ("3", "not a number"), ("3 dog", "unknown")]
)
def test_a_text_that_is_no_quantity_is_refused(text, words):
    with pytest.raises(lt.InputError, match=words):
        quantity_in_si(text)
