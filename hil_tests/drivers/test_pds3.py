"""PDS3 labels: made ones with the forms of MER and MSL, real ones where the reference data are there."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from calib.errors import BadFile
from drivers.recordings.pds3 import Quantity, parse_label, read_product

LABEL = """\
PDS_VERSION_ID                    = PDS3

/* FILE DATA ELEMENTS */
RECORD_TYPE                       = FIXED_LENGTH
RECORD_BYTES                      = 2048
^IMAGE_HEADER                     = 2
^IMAGE                            = 3

PRODUCT_ID                        = 1N000000000TEST
PRODUCER_INSTITUTION_NAME         = "MULTIMISSION IMAGE PROCESSING
                                     SUBSYSTEM, JET PROPULSION LAB"
START_TIME                        = 2012-11-16T21:38:10.723
MSL:REQUEST_ID                    = "0"

GROUP                             = PMA_ARTICULATION_STATE
  ARTICULATION_DEVICE_ANGLE       = (-0.340449 <rad>,-0.10962 <rad>,
                                     -0.340442 <rad>,-0.109557 <rad>)
  ARTICULATION_DEVICE_ANGLE_NAME  = ("AZIMUTH-MEASURED",
                                     "ELEVATION-MEASURED",
                                     "AZIMUTH-REQUESTED"
                                     ,"ELEVATION-REQUESTED")
END_GROUP                         = PMA_ARTICULATION_STATE

OBJECT                            = IMAGE
  LINES                           = 3
  LINE_SAMPLES                    = 4
  SAMPLE_TYPE                     = MSB_INTEGER
  SAMPLE_BITS                     = 16
  SAMPLE_BIT_MASK                 = 2#0000111111111111#
END_OBJECT                        = IMAGE

GROUP                             = GEOMETRIC_CAMERA_MODEL
  CALIBRATION_SOURCE_ID           = 33
  ^MODEL_DESC                     = "GEOMETRIC_CM.TXT"
  MODEL_TYPE                      = CAHVORE
  MODEL_COMPONENT_ID              = (C,A,H,V,O,R,E,T,P)
  MODEL_COMPONENT_1               = (0.609331,-0.041064,-0.233849)
  MODEL_COMPONENT_2               = (0.703447,-0.005161,0.710729)
  MODEL_COMPONENT_3               = (351.362,452.204,353.494)
  MODEL_COMPONENT_4               = (35.8065,-1.75143,682.705)
  MODEL_COMPONENT_5               = (0.704402,-0.006062,0.709775)
  MODEL_COMPONENT_6               = (3e-06,-0.012015,-0.007525)
  MODEL_COMPONENT_7               = (0.001442,0.001522,0.000483)
  MODEL_COMPONENT_8               = 3.0
  MODEL_COMPONENT_9               = 0.37
  REFERENCE_COORD_SYSTEM_NAME     = ROVER_FRAME
END_GROUP                         = GEOMETRIC_CAMERA_MODEL
END
"""
PIXELS = np.array([[1, -2, 300, 4000], [5, 6, 7, 8], [9, 10, 11, -32768]])


def label_bytes(label: str = LABEL, pixels: bytes | None = None) -> bytes:
    """A product: the label padded to two records of 2048 bytes, then the image."""
    text = label.replace("\n", "\r\n").encode()
    return text.ljust(4096) + (PIXELS.astype(">i2").tobytes() if pixels is None else pixels)


def _write(tmp_path: Path, label: str = LABEL, pixels: bytes | None = None) -> Path:
    path = tmp_path / "product.img"
    path.write_bytes(label_bytes(label, pixels))
    return path


def test_an_attached_label_gives_camera_angles_frame_and_image(tmp_path: Path) -> None:
    product = read_product(_write(tmp_path))
    model = product.camera_model
    assert model is not None
    assert (model.kind, model.cahvore_type, model.linearity) == ("CAHVORE", 3, 0.37)
    assert model.size_px == product.size_px == (4, 3)
    assert model.C.tolist() == [0.609331, -0.041064, -0.233849]
    assert model.E.tolist() == [0.001442, 0.001522, 0.000483]
    printed_o = np.array([0.704402, -0.006062, 0.709775])
    np.testing.assert_allclose(model.O, printed_o / np.linalg.norm(printed_o), rtol=0, atol=1e-15)
    assert (product.azimuth_measured_rad, product.elevation_measured_rad) == (-0.340449, -0.10962)
    assert (product.frame, product.product_id) == ("ROVER_FRAME", "1N000000000TEST")
    assert product.image is not None
    np.testing.assert_array_equal(product.image, PIXELS)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("{A, 'B C', \"D\"}", ("A", "B C", "D")),
        ("((1,2),(3,4))", ((1, 2), (3, 4))),
        ("16#fF#", 255),
        ("-1.5E-3 <m/s>", Quantity(-1.5e-3, "m/s")),
        ('"a /* b */ c"', "a /* b */ c"),
        ("1 /* comment */", 1),
        ("12:30:00", "12:30:00"),
    ],
)
def test_values_are_read_as_the_standard_says(text: str, value: object) -> None:
    assert parse_label(f"A = {text}\nEND\n", "x").values["A"] == value


@pytest.mark.parametrize(
    ("text", "line", "phrase"),
    [
        ("A = 1\n", 2, "END is expected"),
        ("A 1\nEND\n", 1, "'=' is expected"),
        ("A = (1,2\nB = 3\nEND\n", 2, "',' or ')'"),
        ('A = "open\nEND\n', 1, "value"),
        ("END_GROUP = A\nEND\n", 1, "no GROUP is open"),
        ("GROUP = A\nEND_GROUP = B\nEND\n", 2, "end of GROUP A"),
        ("A = " + "(" * 5000 + "\nEND\n", 1, "16 sequences"),
        ("GROUP = A\n" * 5000 + "END\n", 17, "16 groups"),
        ("A = 1\nB = /* open\nEND\n", 2, "value"),
    ],
)
def test_what_is_no_label_is_refused_with_its_line(text: str, line: int, phrase: str) -> None:
    with pytest.raises(BadFile) as refused:
        parse_label(text, "x.lbl")
    assert refused.value.place == f"line {line}"
    assert phrase in refused.value.reason
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("sample_type", "bits", "dtype"),
    [
        ("MSB_INTEGER", 16, ">i2"),
        ("LSB_INTEGER", 16, "<i2"),
        ("MSB_UNSIGNED_INTEGER", 16, ">u2"),
        ("UNSIGNED_INTEGER", 8, "u1"),
        ("IEEE_REAL", 32, ">f4"),
    ],
)
def test_samples_of_every_kind_come_out_in_the_machines_order(
    tmp_path: Path, sample_type: str, bits: int, dtype: str
) -> None:
    pixels = np.arange(12).reshape(3, 4) * 11
    label = LABEL.replace("MSB_INTEGER", sample_type).replace("= 16\n", f"= {bits}\n")
    image = read_product(_write(tmp_path, label, pixels.astype(dtype).tobytes())).image
    assert image is not None
    np.testing.assert_array_equal(image, pixels)
    assert image.dtype == np.dtype(dtype).newbyteorder("=")
    assert image.dtype.isnative


def test_prefix_and_suffix_bytes_of_lines_are_left_out(tmp_path: Path) -> None:
    lines = [b"abc" + row.astype(">i2").tobytes() + b"de" for row in PIXELS]
    label = LABEL.replace("  LINES ", "  LINE_PREFIX_BYTES = 3\n  LINE_SUFFIX_BYTES = 2\n  LINES ")
    image = read_product(_write(tmp_path, label, b"".join(lines))).image
    np.testing.assert_array_equal(image, PIXELS)


@pytest.mark.parametrize(
    ("pointer", "start"),
    [('("P.IMG", 3)', 4096), ('("P.IMG", 4097 <BYTES>)', 4096), ('"P.IMG"', 0), ('("P.IMG")', 0)],
)
def test_a_detached_label_finds_its_image_in_either_case(tmp_path: Path, pointer: str, start: int) -> None:
    path = tmp_path / "p.LBL"
    path.write_text(LABEL.replace("^IMAGE                            = 3", f"^IMAGE = {pointer}"))
    absent = read_product(path)
    assert absent.image is None
    assert absent.notes[-1] == "P.IMG is not beside the label; there is no image"
    (tmp_path / "p.img").write_bytes(b" " * start + PIXELS.astype(">i2").tobytes())
    np.testing.assert_array_equal(read_product(path).image, PIXELS)


def test_angles_in_degrees_become_radians_and_other_devices_are_not_the_mast(tmp_path: Path) -> None:
    label = LABEL.replace("-0.340449 <rad>", "-90.0 <deg>")
    assert read_product(_write(tmp_path, label)).azimuth_measured_rad == pytest.approx(-np.pi / 2, abs=1e-15)
    label = LABEL.replace("PMA_ARTICULATION", "HGA_ARTICULATION")
    assert read_product(_write(tmp_path, label)).azimuth_measured_rad is None


BAD_PRODUCTS = [
    ("PDS3", "PDS4", "line 1", "PDS_VERSION_ID"),
    ("= IMAGE\n  LINES ", "= IMAGES\n  LINES ", "line 30", "the end of OBJECT IMAGES is expected"),
    ("OBJECT                            = IMAGE", "GROUP = IMAGE", "line 30", "no OBJECT is open"),
    ("  LINES                           = 3\n", "", "IMAGE.LINES", "nothing"),
    ("  LINES                           = 3", "  LINES = 300", "IMAGE", "at least"),
    ("MSB_INTEGER", "VAX_REAL", "IMAGE.SAMPLE_TYPE", "VAX_REAL"),
    ("= 16\n", "= 12\n", "IMAGE.SAMPLE_BITS", "12"),
    ("  LINES ", "  BANDS = 3\n  LINES ", "IMAGE.BANDS", "1 is expected"),
    ("= 3\n\nPRODUCT", "= 0\n\nPRODUCT", "^IMAGE", "record"),
    ("= 3\n\nPRODUCT", '= "../x"\n\nPRODUCT', "^IMAGE", "beside the label"),
    ("= 2048", '= "many"', "RECORD_BYTES", "integer"),
    ("(351.362,452.204,353.494)", "(351.362,452.204)", "GEOMETRIC_CAMERA_MODEL.MODEL_COMPONENT_3", "three"),
    ("= 3.0", "= 5.0", "GEOMETRIC_CAMERA_MODEL.MODEL_COMPONENT_8", "1, 2 or 3"),
    ("  MODEL_COMPONENT_9 ", "  OTHER ", "GEOMETRIC_CAMERA_MODEL.MODEL_COMPONENT_9", "missing"),
    ("-0.340449 <rad>,-0", "-0", "PMA_ARTICULATION_STATE.ARTICULATION_DEVICE_ANGLE", "as many"),
    ("-0.340449 <rad>", "-0.340449 <m>", "PMA_ARTICULATION_STATE.ARTICULATION_DEVICE_ANGLE", "<rad>"),
]


@pytest.mark.parametrize(("old", "new", "place", "phrase"), BAD_PRODUCTS)
def test_a_malformed_product_is_refused_with_group_and_keyword(
    tmp_path: Path, old: str, new: str, place: str, phrase: str
) -> None:
    assert old in LABEL
    with pytest.raises(BadFile) as refused:
        read_product(_write(tmp_path, LABEL.replace(old, new, 1)))
    assert refused.value.place == place
    assert phrase in refused.value.reason
    assert "\n" not in str(refused.value)


def test_opportunitys_navcam_frames_are_read_as_their_labels_say(reference_data: Path) -> None:
    """A label states minimum, maximum, mean and sum of its pixels: who reads them right gets the same."""
    files = sorted((reference_data / "mer_navcam").glob("1N*.IMG"))
    assert len(files) == 5
    for file in files:
        text = file.read_bytes()[:30_000].decode("latin-1")

        def stated(keyword: str, text: str = text) -> float:
            found = re.search(rf"^\s*{keyword}\s*=\s*([-+.e\d]+)", text, re.MULTILINE)
            assert found is not None
            return float(found[1])

        product = read_product(file)
        image, model = product.image, product.camera_model
        assert image is not None
        assert model is not None
        assert (image.shape, image.dtype, product.size_px) == ((1024, 1024), np.int16, (1024, 1024))
        assert (image.min(), image.max()) == (stated("MINIMUM"), stated("MAXIMUM"))
        assert image.mean() == pytest.approx(stated("MEAN"), rel=1e-5)
        assert image.sum(dtype=np.int64) == pytest.approx(stated("CHECKSUM"), rel=1e-5)
        assert (model.kind, product.frame, product.product_id) == ("CAHVOR", "ROVER_FRAME", file.stem)
    # 1N491020376, read off its label by eye.
    first = read_product(files[0], with_image=False)
    assert first.image is None
    assert first.camera_model is not None
    assert first.camera_model.C.tolist() == [0.442604, -0.0611635, -1.25106]
    assert first.camera_model.V.tolist() == [418.579, -152.039, 1245.75]
    assert first.camera_model.R.tolist() == [0.00096, -0.002183, 0.018547]
    assert (first.azimuth_measured_rad, first.elevation_measured_rad) == (-0.340449, -0.10962)


def test_opportunitys_hazcam_is_a_cahvore_of_type_3(reference_data: Path) -> None:
    product = read_product(
        reference_data / "mer_navcam" / "1F483288473EFFCMUFP1214L0M1.IMG", with_image=False
    )
    model = product.camera_model
    assert model is not None
    assert (model.kind, model.cahvore_type, model.linearity) == ("CAHVORE", 3, 0.37)
