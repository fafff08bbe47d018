from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.cameras.intrinsics import load_intrinsics, read_calibration
from edge.config import load_config
from edge.config_camera import IntrinsicsSettings
from edge.errors import InputError
from msgs.ground.keys import init_authority, issue

LIVE = "[camera]\nintrinsics = { fx = 9, fy = 9, cx = 3, cy = 2, width = 6, height = 4 }\n"
CAMERA = '[camera]\ntype = "sequence"\npath = "scene"\n'


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "config.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (CAMERA + "fps = -3", "config.toml:4: [camera] fps: must be at least 0.01"),
        (CAMERA + "[zenoh]\nimage_max_hz = 1e-300", "config.toml:5: [zenoh] image_max_hz: is 0, for none, or at least"),
        (CAMERA + "[zenoh]\nlisten_on = 3", "config.toml:5: [zenoh] listen_on: unknown key"),
        (CAMERA + "lockstep = 'uav:5'", "config.toml:4: [camera] lockstep: 'uav:5' is neither 127.0.0.1:PORT"),
        ("[vehicle]\nname = 'uav1'", "config.toml: [camera]: is missing"),
        ("[camera]\npath = 'x'", "config.toml:1: [camera]: needs type = one of"),
        ("[camera]\ntype = 'film'", "config.toml:1: [camera]: type must be one of"),
        ("[camera]\ntype = 'file'\npath = 'x.mp4'", "config.toml:1: [camera] intrinsics: is missing"),
        (CAMERA + "[camera.intrinsics]\nfx = 1000", "config.toml:4: [camera] intrinsics: needs file, or all of"),
        (CAMERA + "[mavlink]\nendpoints = ['udpin:1.2.3.4:14550', 'tcp:1']", "config.toml:5: [mavlink] endpoints[1]: "),
        (CAMERA + "[mount]\nR_body_cam = [[1,0,0],[0,1,0],[0,0,-1]]", "[mount]: R_body_cam is not a rotation"),
        (CAMERA + "[mount]\nyaw_deg = 3\nR_body_cam = [[1,0,0],[0,1,0],[0,0,1]]", "[mount]: give either the angles or"),
        (CAMERA + "[mount]\nt_body_cam_m = [250, 0, -40]", "config.toml:5: [mount] t_body_cam_m[0]: must be at most"),
        (CAMERA + "[mavlink]\nattitude_rate_hz = 4", "config.toml:5: [mavlink] attitude_rate_hz: must be at least"),
        (CAMERA + "[mavlink]\ncomponent_id = 1", "config.toml:5: [mavlink] component_id: must be at least"),
        (CAMERA + "[mavlink]\ncomponent_id = 100", "config.toml:4: [mavlink]: component_id and camera_component_id"),
        (CAMERA + "[zenoh]\nmax_age_ms = inf", "config.toml:5: [zenoh] max_age_ms: must be at most"),
        (CAMERA + "[zenoh]\nmax_age_ms = 1e308", "config.toml:5: [zenoh] max_age_ms: must be at most"),
        (CAMERA + "[mavlink]\nmax_age_ms = 1e308", "config.toml:5: [mavlink] max_age_ms: must be at most"),
        (CAMERA + "[recorder]\nfree_min_mb = 1e308", "config.toml:5: [recorder] free_min_mb: must be at most"),
        (CAMERA + "[recorder]\ntotal_max_mb = 1e308", "config.toml:5: [recorder] total_max_mb: must be at most"),
        # 1.8e18 ns are of UTC, and would be waited for for decades.
        (CAMERA + "start_at_ns = 1_800_000_000_000_000_000", "config.toml:4: [camera] start_at_ns: must be at most"),
        (LIVE + "type = 'device'\nwidth = 600000", "config.toml:4: [camera] width: must be at most"),
        (
            LIVE.replace("6,", "600000,") + "type = 'stream'\nurl = 'udp://:5'",
            "config.toml:2: [camera.intrinsics] width: must be at most 65535",
        ),
        ("mount = { roll_deg = nan }\n" + CAMERA, "config.toml:1: [mount] roll_deg: must be a finite number"),
        (
            CAMERA + "[mount]\nR_body_cam = [\n  [0.0, 0.0, 1.0],\n  [1.0, 0.0, 0.0],\n  [0.0, 1.0, 0.0]\n]\nroll = 3",
            "config.toml:10: [mount] roll: unknown key",
        ),
        (CAMERA + "[vehicle]\nname = 'uav 1'", "config.toml:5: [vehicle] name: uav name 'uav 1' must be a letter"),
        (
            LIVE + "type = 'zenoh'\ntopic = '/camera'",
            "config.toml:4: [camera] topic: '/camera' is no ROS topic without",
        ),
        (LIVE + "type = 'stream'\nurl = 'flight.mp4'", "config.toml:4: [camera] url: is no network address such as"),
        (LIVE + "type = 'stream'\nurl = 'file:///a.mp4'", "config.toml:4: [camera] url: is no network address such as"),
        (LIVE + "type = 'stream'\nurl = 'RTSP://a/b'", "config.toml:4: [camera] url: is no network address such as"),
        (
            LIVE + "type = 'device'\ndevice = 'video0'",
            "config.toml:4: [camera] device: 'video0' is no device such as /dev",
        ),
        (LIVE + "type = 'device'\ndevice = 0", 'config.toml:4: [camera] device: must be text, such as "/dev/video0"'),
        (
            "[camera]\ntype = 'device'\nintrinsics = 'camera.yaml'",
            'config.toml:3: [camera] intrinsics: must hold keys with values, such as { file = "camera.yaml" }',
        ),
        (LIVE + "type = 'device'\nfourcc = 'MJ'", "config.toml:4: [camera] fourcc: must have 4 or more characters"),
        (CAMERA + "[mavlink]\nendpoints = []", "config.toml:5: [mavlink] endpoints: must have 1 or more items, not 0"),
        (LIVE + "type = 'device'\nfps = true", "config.toml:4: [camera] fps: must be a number"),
        (CAMERA + "[model]\nthreads = '2'", "config.toml:5: [model] threads: must be a whole number"),
        (CAMERA + "[mavlink]\nenabled = 0", "config.toml:5: [mavlink] enabled: must be true or false"),
        (CAMERA + "[mount]\nt_body_cam_m = 3", "config.toml:5: [mount] t_body_cam_m: must be a list"),
        (CAMERA + "[mount]\nt_body_cam_m = [true, 0, 0]", "config.toml:5: [mount] t_body_cam_m[0]: must be"),
        (CAMERA + "[model]\npath = 3", "config.toml:5: [model] path: must be text"),
        (CAMERA + "[target]\nwingspan_m = 11", "config.toml:4: [target]: give both wingspan_m and length_m"),
        (CAMERA + "[target]\nwingspan_m = 11\nlength_m = 8000", "config.toml:6: [target] length_m: must be at most"),
        ("camera = 3", "config.toml:1: [camera]: must hold keys with values"),
        ("zenoh = 3\n" + CAMERA, "config.toml:1: [zenoh]: must hold keys with values"),
        ("[camera\n", "config.toml: not valid TOML: "),
    ],
)
def test_a_fault_is_told_with_file_line_and_key(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(InputError) as error:
        load_config(write(tmp_path, text))
    assert sentence in str(error.value)


@pytest.mark.parametrize("path", ["~nosuchuser/rec", "circle/rec"])
def test_a_path_that_leads_nowhere_is_told_with_file_line_and_key(tmp_path: Path, path: str) -> None:
    (tmp_path / "circle").symlink_to("circle")
    with pytest.raises(InputError) as error:
        load_config(write(tmp_path, f"{CAMERA}[recorder]\nfolder = '{path}'"))
    assert f"config.toml:5: [recorder] folder: '{path}' leads nowhere: " in str(error.value)


@pytest.mark.parametrize(
    ("one", "other", "excluded"),
    [
        ('[zenoh]\nlisten = ["tcp/127.0.0.1:7448"]', "[health]\nprometheus_port = 7448", True),
        ('[zenoh]\nlisten = ["tls/0.0.0.0:7448?a=1#b=2"]\ntls = {tls}', "[health]\nprometheus_port = 7448", True),
        ('[zenoh]\nlisten = ["quic/0.0.0.0:7448"]\ntls = {tls}', "[health]\nprometheus_port = 7448", False),
        ('[zenoh]\nlisten = ["tcp/10.0.0.1:7448"]', "[health]\nprometheus_port = 7448", False),
        ('[zenoh]\nenabled = false\nlisten = ["tcp/127.0.0.1:7448"]', "[health]\nprometheus_port = 7448", False),
        ('[zenoh]\nlisten = ["tcp/[::]:5760"]', '[mavlink]\nendpoints = ["tcpin:10.0.0.1:5760"]', True),
        ('[zenoh]\nlisten = ["tcp/[::1]:5760"]', '[mavlink]\nendpoints = ["tcpin:0.0.0.0:5760"]', False),
        ('[zenoh]\nlisten = ["tcp/ground:5760"]', '[mavlink]\nendpoints = ["tcpin:Ground:5760"]', True),
        ('[zenoh]\nlisten = ["tcp/ground:5760"]', '[mavlink]\nendpoints = ["tcpin:10.0.0.1:5760"]', False),
        ('[zenoh]\nlisten = ["tcp/0.0.0.0:5760"]', '[mavlink]\nendpoints = ["tcpout:0.0.0.0:5760"]', False),
        ('[zenoh]\nlisten = ["tcp/0.0.0.0:5760"]', '[mavlink]\nendpoints = ["udpin:0.0.0.0:5760"]', False),
        ('[zenoh]\nlisten = ["tcp/0.0.0.0:0"]', '[mavlink]\nendpoints = ["tcpin:0.0.0.0:0"]', False),
        ("", '[mavlink]\nendpoints = ["tcpin:[::ffff:10.0.0.1]:5760", "tcpin:10.0.0.1:5760"]', True),
        ("", '[mavlink]\nendpoints = ["tcpin:10.0.0.1:5760", "tcpin:10.0.0.2:5760"]', False),
        ("", '[mavlink]\nendpoints = ["udpin:[::]:14550", "udpin:127.0.0.1:14550"]', True),
        ("", '[mavlink]\nendpoints = ["udpin:127.0.0.1:14550", "udpout:127.0.0.1:14550"]', False),
        ('[zenoh]\nlisten = ["quic/[::1]:7448"]\ntls = {tls}', '[mavlink]\nendpoints = ["udpin:[::1]:7448"]', True),
        ("", '[zenoh]\nlisten = ["tcp/127.0.0.1:7448", "tcp/0.0.0.0:7448"]', True),
    ],
)
def test_two_listeners_that_cannot_both_open_are_refused(tmp_path: Path, one: str, other: str, excluded: bool) -> None:
    init_authority(tmp_path)
    issue(tmp_path, "uav1")
    tls = '{ root_ca = "ca.pem", certificate = "uav1.pem", private_key = "uav1.key" }'
    path = write(tmp_path, f"{CAMERA}{one.replace('{tls}', tls)}\n{other}\n")
    if not excluded:
        load_config(path)
        return
    with pytest.raises(InputError, match=r"the file: \[.*\] .* and \[.*\] .* need the same (TCP|UDP) port; change"):
        load_config(path)


def test_every_fault_is_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        load_config(write(tmp_path, CAMERA + "fps = 0\n[model]\nthreads = 0\n"))
    assert [line.split(": ")[1] for line in str(error.value).splitlines()] == ["[camera] fps", "[model] threads"]


def test_paths_are_taken_from_the_folder_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    config = load_config(write(tmp_path, CAMERA)).config
    assert config.camera.type == "sequence"
    assert config.camera.path == tmp_path / "scene"


@pytest.mark.parametrize(
    ("angles", "axis_cam", "axis_body"),
    [
        ("", (0, 0, 1), (1, 0, 0)),  # it looks along the nose,
        ("", (1, 0, 0), (0, 1, 0)),  # its right is the vehicle's right
        ("yaw_deg = 90", (0, 0, 1), (0, 1, 0)),  # turned to the right
        ("pitch_deg = -90", (0, 0, 1), (0, 0, 1)),  # looking down
        ("roll_deg = 90", (1, 0, 0), (0, 0, 1)),  # its right side down
    ],
)
def test_mount_angles_turn_the_camera_as_described(
    tmp_path: Path, angles: str, axis_cam: tuple[int, ...], axis_body: tuple[int, ...]
) -> None:
    mount = load_config(write(tmp_path, CAMERA + "[mount]\n" + angles)).config.mount.mount()
    np.testing.assert_allclose(mount.R_body_cam @ np.array(axis_cam), axis_body, atol=1e-12)


@given(st.floats(0.5, 0.999), st.integers(0, 2))
def test_a_written_matrix_becomes_exactly_orthonormal(noise: float, axis: int) -> None:
    from edge.config import MountSettings

    R = np.eye(3)
    R[axis, (axis + 1) % 3] = 4e-4 * noise  # as a person rounds it
    mount = MountSettings(R_body_cam=R.tolist()).mount()
    np.testing.assert_allclose(mount.R_body_cam @ mount.R_body_cam.T, np.eye(3), atol=1e-12)


ROS_CALIBRATION = """\
image_width: 1280
image_height: 720
camera_name: nose
camera_matrix:
  rows: 3
  cols: 3
  data: [1100.5, 0.0, 640.25, 0.0, 1101.0, 359.75, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.02, 0.001, -0.002, 0.0]
"""
OPENCV_CALIBRATION = """\
%YAML:1.0
---
image_width: 1280
image_height: 720
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1100.5, 0., 640.25, 0., 1101., 359.75, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.1, 0.02, 0.001, -0.002, 0. ]
"""


@pytest.mark.parametrize("text", [ROS_CALIBRATION, OPENCV_CALIBRATION], ids=["ros", "opencv"])
def test_calibrations_of_ros_and_opencv_are_read(tmp_path: Path, text: str) -> None:
    path = tmp_path / "nose.yaml"
    path.write_text(text)
    intrinsics = read_calibration(path)
    assert intrinsics.image_size_wh == (1280, 720)
    assert intrinsics.K.tolist() == [[1100.5, 0, 640.25], [0, 1101.0, 359.75], [0, 0, 1]]
    assert intrinsics.distortion == (-0.1, 0.02, 0.001, -0.002, 0.0)


@pytest.mark.parametrize(
    ("written", "instead", "said"),
    [
        ("-0.1", "\N{MINUS SIGN}0.1", r"distortion_coefficients holds '\N{MINUS SIGN}0\.1' in place of a number"),
        ("0.001", "O.001", r"distortion_coefficients holds 'O\.001'"),
        ("0.001", "[0.001]", "distortion_coefficients holds a list"),
        ("0.001", ".Inf", "distortion_coefficients takes 4, 5 or 8 numbers"),
        ("cols: 5\n  data", "cols: 5\n  date", "distortion_coefficients has no list of data"),
        ("640.25", "O.25", r"camera_matrix holds 'O\.25'"),
        ("1100.5", ".NaN", "camera_matrix is not 9 finite numbers"),
        (", 1.0]", "]", "camera_matrix is not 9 finite numbers"),
        ("1101.0", "-1101.0", "camera_matrix has no positive focal lengths"),
        ("0.0, 640.25, 0.0, 1101.0, 359.75, 0.0, 0.0", "0, 0, 0, 1101, 0, 640.25, 359.75", "camera_matrix is not, row"),
        ("640.25, 0.0", "640.25, 7.5", "camera_matrix is not, row by row, fx 0 cx, 0 fy cy, 0 0 1"),
        (", 1.0]", ", 0.0]", "camera_matrix is not, row by row"),
        (", 1.0]", ", 2.0]", "camera_matrix is not, row by row"),
        ("width: 1280", "width: .Inf", "image_width is missing or no whole number from 1"),
        ("width: 1280", "width: 4000000000", "image_width is missing or no whole number from 1 to 65535"),
        ("width: 1280", "width: 1280.7", "image_width is missing"),
        ("width: 1280", "width: [1280]", "image_width holds a list"),
        ("height: 720", "height: ~", "image_height holds '~'"),
        ("image_height: 720\n", "", "image_height is missing"),
        ("coefficients", "coeffs", r"distortion_coefficients is missing; a camera without distortion says data: \[\]"),
    ],
)  # fmt: skip
def test_a_calibration_with_what_is_no_number_or_no_camera_is_told_with_its_key(
    tmp_path: Path, written: str, instead: str, said: str
) -> None:
    assert ROS_CALIBRATION.count(written) == 1
    path = tmp_path / "nose.yaml"
    path.write_text(ROS_CALIBRATION.replace(written, instead), encoding="utf-8")
    with pytest.raises(InputError, match=rf"^calibration {path}: {said}") as refused:
        read_calibration(path)
    assert refused.value.key == ("camera", "intrinsics")


@pytest.mark.parametrize(
    ("written", "instead", "said"),
    [
        ("1100.5", "2.0", "fx 2 and fy 1101 cannot be of one camera"),
        ("640.25", "64025", r"the principal point \(64025, 359\.75\) is far outside the picture of 1280x720"),
        ("359.75", "-480", r"the principal point \(640\.25, -480\) is far outside"),
        ("-0.1, 0.02", "-28.0, 9.0", "the distortion folds the picture over itself in its middle half"),
    ],
)
def test_numbers_of_no_camera_are_told_before_a_flight(tmp_path: Path, written: str, instead: str, said: str) -> None:
    assert ROS_CALIBRATION.count(written) == 1
    path = tmp_path / "nose.yaml"
    path.write_text(ROS_CALIBRATION)
    sound = load_intrinsics(IntrinsicsSettings(file=path))
    path.write_text(ROS_CALIBRATION.replace(written, instead))
    with pytest.raises(InputError, match=rf"nose\.yaml: {said}") as refused:
        load_intrinsics(IntrinsicsSettings(file=path))
    assert refused.value.key == ("camera", "intrinsics")
    assert sound.image_size_wh == (1280, 720)


@pytest.mark.parametrize(("focal_px", "fits"), [(8.0, False), (50.0, False), (480.0, True), (90_000.0, True)])
def test_a_focal_length_in_millimetres_is_told_before_a_flight(focal_px: float, fits: bool) -> None:
    numbers = {"fx": focal_px, "fy": focal_px, "cx": 959.5, "cy": 539.5, "width": 1920, "height": 1080}
    if fits:
        assert load_intrinsics(IntrinsicsSettings(**numbers)).K[0, 0] == focal_px
    else:
        with pytest.raises(InputError, match=rf"fx {focal_px:g} px shows 17[0-9] degrees across 1920 px"):
            load_intrinsics(IntrinsicsSettings(**numbers))


def test_a_lens_that_shows_nothing_in_the_corners_is_a_lens() -> None:
    numbers = {"fx": 1000.0, "fy": 1000.0, "cx": 959.5, "cy": 539.5, "width": 1920, "height": 1080}
    assert load_intrinsics(IntrinsicsSettings(distortion=[-0.3, 0.0, 0.0, 0.0], **numbers)).distortion[0] == -0.3


@pytest.mark.parametrize(
    ("written", "instead"),
    [
        ("camera_name: nose", "camera_name: HD Pro Webcam (046d:082d)"),
        ("camera_name: nose", "camera_name: USB 2.0 Camera: left"),
        ("camera_name: nose", "camera_name:"),
        ("camera_name: nose", "camera_name:\n  nose: left"),
        ("camera_name: nose", 'camera_name: "[nose"'),
        ("image_width", "\N{ZERO WIDTH NO-BREAK SPACE}image_width"),  # as an editor may begin a file
        ("plumb_bob", "plumb_bob  # k1 k2 p1 p2 k3"),
        ("image_height: 720", "image_height: 720\t# as it reads out\n# focused at infinity"),
    ],
)
def test_a_calibration_is_read_whatever_its_camera_is_called_and_its_comments_say(
    tmp_path: Path, written: str, instead: str
) -> None:
    assert ROS_CALIBRATION.count(written) == 1
    path = tmp_path / "nose.yaml"
    path.write_text(ROS_CALIBRATION.replace(written, instead), encoding="utf-8")
    intrinsics = read_calibration(path)
    assert intrinsics.image_size_wh == (1280, 720)
    assert intrinsics.distortion == (-0.1, 0.02, 0.001, -0.002, 0.0)


@pytest.mark.parametrize(("cols", "data"), [("5", "0.0, 0.0, 0.0, 0.0, 0.0"), ("0", "")])
def test_a_calibration_without_distortion_says_so_as_ros_does(tmp_path: Path, cols: str, data: str) -> None:
    path = tmp_path / "nose.yaml"
    text = ROS_CALIBRATION.replace("cols: 5", f"cols: {cols}").replace("-0.1, 0.02, 0.001, -0.002, 0.0", data)
    path.write_text(text)
    assert not any(load_intrinsics(IntrinsicsSettings(file=path)).distortion)


def test_what_a_product_of_matrices_leaves_of_a_zero_is_rounding(tmp_path: Path) -> None:
    path = tmp_path / "nose.yaml"
    path.write_text(ROS_CALIBRATION.replace("0.0, 0.0, 1.0]", "-3e-17, 2.2e-16, 1.0000000000000002]"))
    assert read_calibration(path).image_size_wh == (1280, 720)


@pytest.mark.parametrize("text", ["", "image_width: 10\n", "{[", ROS_CALIBRATION.replace("1100.5", "-3")])
def test_a_broken_calibration_is_told(tmp_path: Path, text: str) -> None:
    path = tmp_path / "nose.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"nose\.yaml"):
        read_calibration(path)


def test_a_file_that_an_editor_began_with_a_mark_is_read(tmp_path: Path) -> None:
    write(tmp_path, CAMERA).write_text("\N{ZERO WIDTH NO-BREAK SPACE}" + CAMERA, encoding="utf-8")
    assert load_config(tmp_path / "config.toml").config.camera.type == "sequence"


def test_a_calibration_that_opencv_does_not_read_is_told_as_that(tmp_path: Path) -> None:
    path = tmp_path / "nose.yaml"
    with pytest.raises(InputError, match=r"nose\.yaml cannot be read: No such file"):
        read_calibration(path)
    for content, said in (
        (b"\xff\xfe", "cannot be read: not UTF-8 text"),
        (b"", "is not YAML as OpenCV reads it; lists"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=said):
            read_calibration(path)
    for written, instead, line, said in (
        ("data: [-0.1, 0.02, 0.001, -0.002, 0.0]", "data:\n  - -0.1\n  - 0.02", 13, "Incorrect indentation"),
        ("  cols: 5", "\tcols: 5", 11, "Tabs are prohibited in YAML"),
        ("0.0]\n", "0.0]\nnonsense\n", 13, "Missing ':'"),
    ):
        text = ROS_CALIBRATION.replace(written, instead)
        for head, lines in (("", 0), ("---\n", 1), ("%YAML 1.2\n---\n", 2)):
            path.write_text(head + text)
            with pytest.raises(InputError, match=r"nose\.yaml is not YAML as OpenCV reads it") as refused:
                read_calibration(path)
            assert f", line {line + lines}: {said}; lists stand in brackets" in str(refused.value)
