"""Files of vector fields: written and read again, and files as OOMMF and mumax3 write them."""

import struct

import numpy as np
import pytest

import liethermo as lt

mag = lt.magnetism
VALUES = np.random.default_rng(4).standard_normal((4, 3, 2, 3))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("representation", ["text", "binary 4", "binary 8"])
def test_what_is_written_is_read(version, representation, tmp_path):
    path = tmp_path / "m.ovf"
    mag.write_ovf(path, VALUES, (1e-9, 2e-9, 3e-9), representation, version, title="m of a film", unit="A/m")
    field = mag.read_ovf(path)
    tolerance = 1e-7 if representation == "binary 4" else 0.0
    np.testing.assert_allclose(field.values, VALUES, rtol=tolerance, atol=tolerance)
    assert (field.size, field.title, field.unit) == ((1e-9, 2e-9, 3e-9), "m of a film", "A/m")
    np.testing.assert_allclose(field.origin, (0.5e-9, 1e-9, 1.5e-9))


MUMAX_HEADER = """# OOMMF OVF 2.0
# Segment count: 1
# Begin: Segment
# Begin: Header
# Title: m
# meshtype: rectangular
# meshunit: m
# xmin: 0
# ymin: 0
# zmin: 0
# xmax: 4e-09
# ymax: 2e-09
# zmax: 1e-09
# valuedim: 3
# valuelabels: m_x m_y m_z
# valueunits: 1 1 1
# Desc: Total simulation time:  0  s
# xbase: 1e-09
# ybase: 1e-09
# zbase: 5e-10
# xnodes: 2
# ynodes: 1
# znodes: 1
# xstepsize: 2e-09
# ystepsize: 2e-09
# zstepsize: 1e-09
# End: Header
"""

OOMMF_FILE = """# OOMMF: rectangular mesh v1.0
#
## This is a comment.
# Segment count: 1
# Begin: Segment
# Begin: Header
# Title: Long file title goes here
# meshunit: nm
# valueunit: A/m
# valuemultiplier: 1000
# xmin: 0
# ymin: 0
# zmin: 0
# xmax: 2
# ymax: 4
# zmax: 1
# ValueRangeMinMag: 1e-08
# ValueRangeMaxMag: 1
# meshtype: rectangular
# xbase: 0.5
# ybase: 1
# zbase: 0.5
# xstepsize: 1.0
# ystepsize: 2.0   ## with a comment
# zstepsize: 1.0
# xnodes: 2
# ynodes: 2
# znodes: 1
# End: Header
# Begin: Data Text
1 0 0
2 0 0
3 0 0
4 0 0.5
# End: Data Text
# End: Segment
"""


def test_a_file_of_mumax3_in_four_bytes(tmp_path):
    path = tmp_path / "m000000.ovf"
    data = struct.pack("<7f", 1234567.0, 1.0, 0.0, 0.0, 0.0, 0.5, -1.0)
    text = MUMAX_HEADER + "# Begin: Data Binary 4\n"
    path.write_bytes(text.encode() + data + b"\n# End: Data Binary 4\n# End: Segment\n")
    field = mag.read_ovf(path)
    np.testing.assert_array_equal(field.values[:, 0, 0], [[1.0, 0.0, 0.0], [0.0, 0.5, -1.0]])
    assert field.size == (2e-9, 2e-9, 1e-9)


def test_a_text_file_of_oommf_has_x_first_and_a_multiplier(tmp_path):
    path = tmp_path / "old.omf"
    path.write_text(OOMMF_FILE)
    field = mag.read_ovf(path)
    np.testing.assert_array_equal(field.values[:, :, 0, 0], [[1000.0, 3000.0], [2000.0, 4000.0]])
    assert field.values[1, 1, 0, 2] == 500.0
    assert (field.unit, field.length_unit, field.size) == ("A/m", "nm", (1.0, 2.0, 1.0))


def test_bytes_of_version_1_are_in_network_order(tmp_path):
    path = tmp_path / "m.ovf"
    mag.write_ovf(path, VALUES, 1e-9, "binary 8", version=1)
    content = path.read_bytes()
    start = content.index(b"Data Binary 8\n") + len(b"Data Binary 8\n")
    assert struct.unpack(">d", content[start : start + 8])[0] == 123456789012345.0
    assert struct.unpack(">d", content[start + 8 : start + 16])[0] == VALUES[0, 0, 0, 0]


def test_damaged_files_are_refused(tmp_path):
    path = tmp_path / "m.ovf"
    mag.write_ovf(path, VALUES, 1e-9, "binary 8")
    content = path.read_bytes()
    cases = {
        "is not complete": content[:-200],
        "is damaged": content.replace(struct.pack("<d", 123456789012345.0), struct.pack("<d", 1.0)),
        "is not an OVF file": b"hello\n" + content,
        "irregular mesh": content.replace(b"meshtype: rectangular", b"meshtype: irregular"),
        "no valid header": content.replace(b"xnodes", b"xknots"),
        "has no data": content[:300],
        "of the kind": content.replace(b"Begin: Data Binary 8", b"Begin: Data Binary 2"),
    }
    for message, damaged in cases.items():
        path.write_bytes(damaged)
        with pytest.raises(lt.LiethermoError, match=message):
            mag.read_ovf(path)
    path.write_text(OOMMF_FILE.replace("4 0 0.5\n", ""))
    with pytest.raises(lt.LiethermoError, match="must have 12 numbers, got 9"):
        mag.read_ovf(path)
    with pytest.raises(lt.LiethermoError, match="could not be read"):
        mag.read_ovf(tmp_path / "absent.ovf")
    with pytest.raises(lt.LiethermoError, match="representation must be"):
        mag.write_ovf(path, VALUES, 1e-9, "binary 16")
    with pytest.raises(lt.LiethermoError, match="shape"):
        mag.write_ovf(path, VALUES[0], 1e-9)


@pytest.mark.parametrize("representation", ["text", "binary 4", "binary 8"])
def test_a_header_that_does_not_fit_its_data_is_refused(representation, tmp_path):
    path = tmp_path / "field.ovf"
    mag.write_ovf(path, VALUES, 1e-9, representation)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"valuedim: 3", b"valuedim: 2"))
    with pytest.raises(lt.LiethermoError, match="Its header does not fit its data"):
        mag.read_ovf(path)
    for key in (b"xstepsize: ", b"ybase: "):
        for value in (b"nan\n# x: ", b"0\n# x: " if key == b"xstepsize: " else b"inf\n# x: "):
            path.write_bytes(content.replace(key, key + value))
            with pytest.raises(lt.LiethermoError, match="positive edges of cells and finite numbers"):
                mag.read_ovf(path)


@pytest.mark.parametrize("version", [1, 2])
def test_titles_and_units_come_back(version, tmp_path):
    path = tmp_path / "field.ovf"
    for title, unit in (("µMAG 4: m / M, # 1", "A / m"), ("m", "µT"), ("", "1")):
        mag.write_ovf(path, VALUES, 1e-9, "binary 8", version, title, unit)
        field = mag.read_ovf(path)
        assert (field.title, field.unit) == (title, unit)
    path.write_bytes(path.read_bytes().replace(b"Title: ", b"Title: \xb5MAG"))  # Latin-1
    assert mag.read_ovf(path).title == "µMAG"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"values": "x"}, "must be made of real numbers"),
        ({"values": 1j * VALUES}, "must be made of real numbers"),
        ({"values": VALUES[:, :0]}, "must have shape"),
        ({"values": 1e300 * np.ones((1, 1, 1, 3)), "representation": "binary 4"}, 'Use "binary 8"'),
        ({"size": np.inf}, "positive and finite edges"),
        ({"origin": (0.0, 1.0)}, "three finite numbers"),
        ({"origin": (0.0, np.nan, 1.0)}, "three finite numbers"),
        ({"title": "a ## b"}, "begins a comment"),
        ({"title": 3}, "title must be a single line"),
        ({"unit": "{T}"}, "braces"),
    ],
)
def test_what_a_file_cannot_hold_is_refused(arguments, message, tmp_path):
    with pytest.raises(lt.InputError, match=message):
        mag.write_ovf(tmp_path / "field.ovf", **{"values": VALUES, "size": 1e-9} | arguments)
