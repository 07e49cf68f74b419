"""Message definitions of camera topics that are not among the standard types of rosbags.

Fields follow the definitions of foxglove_msgs (Foxglove SDK, schemas ros1 and ros2) and of
ffmpeg_image_transport_msgs (msg/FFMPEGPacket.msg).
"""

from __future__ import annotations

IMAGE = "sensor_msgs/msg/Image"
INFO = "sensor_msgs/msg/CameraInfo"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
TF = "tf2_msgs/msg/TFMessage"
PACKET = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
RAW_IMAGE = "foxglove_msgs/msg/RawImage"
CODED_IMAGE = "foxglove_msgs/msg/CompressedImage"
CODED_VIDEO = "foxglove_msgs/msg/CompressedVideo"
CALIBRATION = "foxglove_msgs/msg/CameraCalibration"
TRANSFORM = "foxglove_msgs/msg/FrameTransform"
LOG = "foxglove_msgs/msg/Log"
POSE = "foxglove_msgs/msg/PoseInFrame"
PICTURES = frozenset({IMAGE, COMPRESSED, PACKET, RAW_IMAGE, CODED_IMAGE, CODED_VIDEO})

_STAMP = "builtin_interfaces/Time timestamp\nstring frame_id\n"
_MATRICES = "float64[] {d}\nfloat64[9] {k}\nfloat64[9] {r}\nfloat64[12] {p}\n"
_LEVELS = "uint8 UNKNOWN=0\nuint8 DEBUG=1\nuint8 INFO=2\nuint8 WARNING=3\nuint8 ERROR=4\n"

_DEFINITIONS = {
    TF: "geometry_msgs/TransformStamped[] transforms\n",
    "tf/msg/tfMessage": "geometry_msgs/TransformStamped[] transforms\n",
    PACKET: (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\n"
        "uint8 flags\nbool is_bigendian\nuint8[] data\n"
    ),
    RAW_IMAGE: (
        f"{_STAMP}uint32 width\nuint32 height\nstring encoding\nuint32 step\nuint8[] data\n"
    ),
    CODED_IMAGE: f"{_STAMP}uint8[] data\nstring format\n",
    CODED_VIDEO: f"{_STAMP}uint8[] data\nstring format\n",
    CALIBRATION: f"{_STAMP}uint32 width\nuint32 height\nstring distortion_model\n{_MATRICES}",
    TRANSFORM: (
        "builtin_interfaces/Time timestamp\nstring parent_frame_id\nstring child_frame_id\n"
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    ),
    f"{TRANSFORM}s": "foxglove_msgs/FrameTransform[] transforms\n",
    LOG: (
        f"builtin_interfaces/Time timestamp\n{_LEVELS}uint8 FATAL=5\nuint8 level\n"
        "string message\nstring name\nstring file\nuint32 line\n"
    ),
    POSE: f"{_STAMP}geometry_msgs/Pose pose\n",
}


def definitions(encoding: str) -> dict[str, str]:
    """Definition by type for ``ros1`` or ``cdr``: matrices are upper case in ROS 1 only."""
    names = {name: name.upper() if encoding == "ros1" else name for name in "dkrp"}
    return {
        msgtype: text.format(**names) if "{d}" in text else text
        for msgtype, text in _DEFINITIONS.items()
    }
