"""States and actions beside frames: numbers of recorded messages, by the clock of the cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

import mp4ds
from conftest import DATA
from mp4ds.dataset.vectors import read_vectors
from scenes import PERIOD, START, Record, Scene, scene
from sources import SOURCES

torch = pytest.importorskip("torch")

from torch.utils.data import DataLoader  # noqa: E402

from mp4ds.torch import FrameDataset, FrameStream  # noqa: E402

LEFT, RIGHT, JOINTS, COMMAND, ODOM, TASK = (
    "/left/image_raw",
    "/right/image_raw",
    "/joint_states",
    "/command",
    "/odom",
    "/task",
)
BOTH = [LEFT, RIGHT]
FRAMES = 24
NAMES = ["shoulder", "elbow", "finger"]

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*fork.*:DeprecationWarning", "ignore:This process .* is multi-threaded"
)


def joints_at(n: int) -> list[float]:
    return [0.1 * n, -0.2 * n, 0.01 * n]


def robot() -> Scene:
    """Two cameras; joints three times as fast; commands as arrays without a header; tasks."""
    messages: list[Record] = []
    for seed, topic in enumerate((LEFT, RIGHT)):
        made = scene("rgb8", frames=FRAMES, seed=seed, with_info=False, noisy=False)
        images = [one for one in made.messages if one.topic == "/cam/image_raw"]
        messages += [replace(one, topic=topic) for one in images]
    for n in range(3 * FRAMES):
        time = START + n * PERIOD // 3
        header = {"stamp": time, "frame_id": ""}
        joints = {"header": header, "name": NAMES, "position": joints_at(n), "velocity": [1.5] * 3}
        messages.append(Record(JOINTS, "sensor_msgs/msg/JointState", time + 2_000_000, joints))
        if n % 3 == 2:
            data = {"data": [1.0 * n, 2.0 * n]}
            messages.append(Record(COMMAND, "std_msgs/msg/Float32MultiArray", time, data))
        pose = {"position": {"x": 0.5 * n, "z": 2.0}, "orientation": {"w": 1.0}}
        values = {"header": header, "child_frame_id": "base", "pose": {"pose": pose}}
        messages.append(Record(ODOM, "nav_msgs/msg/Odometry", time, values))
    for n, text in ((3, "push"), (9, ""), (12, "pull"), (18, "pull"), (20, "")):
        record = Record(TASK, "std_msgs/msg/String", START + n * PERIOD - PERIOD // 2)
        messages.append(replace(record, values={"data": text}))
    return Scene(sorted(messages, key=lambda message: message.log_time))


def packed(folder: Path, made: Scene, source: str = "mcap-ros2-none") -> Path:
    paths = SOURCES[source](folder / "source", made)
    mp4ds.pack(paths, folder / "drive", mp4ds.PackOptions(codec="h264", gop=6, quality="visual"))
    return folder / "drive"


def changed(made: Scene, topic: str, **values: Any) -> Scene:
    """The scene with other values of a topic, and maybe of another ``topic``."""
    name = values.pop("name_of_topic", topic)
    return Scene(
        [
            replace(one, topic=name, values={**one.values, **values}) if one.topic == topic else one
            for one in made.messages
        ]
    )


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The robot; not to be changed."""
    return packed(tmp_path_factory.mktemp("robot"), robot())


def stamps_of(made: Scene, topic: str) -> np.ndarray[Any, Any]:
    """Stamps, or log times where there are none."""
    return np.array(
        [
            one.values["header"]["stamp"] if "header" in one.values else one.log_time
            for one in made.messages
            if one.topic == topic
        ]
    )


STAMPS = {topic: stamps_of(robot(), topic) for topic in (LEFT, RIGHT, JOINTS, COMMAND)}


def expected(topic: str, time: int, previous: bool) -> tuple[list[float], float]:
    """Numbers of the message for a time, and how far away it is."""
    away = time - STAMPS[topic]
    which = np.flatnonzero(away >= 0)[-1] if previous else np.abs(away).argmin()
    values = joints_at(which) if topic == JOINTS else [3.0 * which + 2, 6.0 * which + 4]
    return values, abs(away[which])


def test_states_and_actions(drive: Path) -> None:
    frames = FrameDataset(
        drive,
        topics=[LEFT],
        state=JOINTS,
        action={COMMAND: "data"},
        action_offsets=(0, 1, 2),
        offsets=(-1, 0),
    )
    assert frames.names == {"state": tuple(NAMES), "action": ("command_0", "command_1")}
    for row in (0, 7, FRAMES - 2, FRAMES - 1):
        sample = frames[row]
        for key, topic, offsets in (("state", JOINTS, (-1, 0)), ("action", COMMAND, (0, 1, 2))):
            assert sample[key].dtype == torch.float32
            wanted = [row + offset for offset in offsets]
            rows = np.clip(wanted, 0, FRAMES - 1)
            found = [expected(topic, STAMPS[LEFT][n], previous=False)[0] for n in rows]
            assert sample[key].numpy() == pytest.approx(np.array(found), rel=1e-6)
            assert sample[f"{key}_is_pad"].tolist() == (rows != wanted).tolist()
    single = FrameDataset(drive, topics=[LEFT], state=JOINTS)[5]
    assert (single["state"].shape, single["state_is_pad"].tolist()) == ((3,), [False])


@pytest.mark.parametrize("message", ["nearest", "previous"])
@pytest.mark.parametrize("tolerance", [None, 3_000_000])
def test_the_message_of_a_time(drive: Path, message: Any, tolerance: int | None) -> None:
    frames = FrameDataset(
        drive,
        topics=[LEFT],
        action=COMMAND,
        action_offsets=(0, 0.05),
        offsets_in="seconds",
        message=message,
        message_tolerance_ns=tolerance,
    )
    for row in (3, 11, 20):
        sample = frames[row]
        for n, offset in enumerate((0, 50_000_000)):
            time = STAMPS[LEFT][row] + offset
            values, away = expected(COMMAND, time, previous=message == "previous")
            assert sample["action"][n].tolist() == values
            assert bool(sample["action_is_pad"][n]) == (tolerance is not None and away > tolerance)
    if message == "previous":  # the first command comes after the first frame
        assert frames[0]["action_is_pad"][0]


def test_fields(drive: Path, tmp_path: Path) -> None:
    """Of messages in messages, of arrays by number and name, of JSON; several topics in a row."""
    state: Mapping[str, Any] = {
        JOINTS: ["position[elbow]", "velocity[0:2]", "position[finger]"],
        ODOM: "pose.pose.position",
    }
    number = 10
    for dataset in (drive, packed(tmp_path / "json", robot(), "mcap-none-profile")):
        where = {"x": 0.5 * 3 * number, "y": 0.0, "z": 2.0}
        if dataset != drive:  # JSON has the fields that were given
            where.pop("y")
        frames = FrameDataset(dataset, topics=[LEFT], state=state)
        joints = [f"position.{NAMES[1]}", f"velocity.{NAMES[0]}", f"velocity.{NAMES[1]}"]
        assert frames.names["state"] == (
            *joints,
            f"position.{NAMES[2]}",
            *(f"pose.pose.position.{axis}" for axis in where),
        )
        row = next(n for n in range(FRAMES) if STAMPS[LEFT][n] >= STAMPS[JOINTS][3 * number])
        _, elbow, finger = joints_at(3 * row)
        expected = [elbow, 1.5, 1.5, finger, 0.5 * 3 * row, *[*where.values()][1:]]
        assert frames[row]["state"].tolist() == pytest.approx(expected)


def test_recordings_with_other_names(drive: Path, tmp_path: Path) -> None:
    """Topics are renamed, and joints in another order are put into that of the first."""
    made = changed(robot(), LEFT, name_of_topic="/cam0/image")
    messages = []
    for one in made.messages:
        if one.topic == JOINTS:
            values = {**one.values, "name": NAMES[::-1], "position": one.values["position"][::-1]}
            one = replace(one, topic="/robot/joints", values=values)
        messages.append(one)
    other = packed(tmp_path / "other", Scene(messages))
    rename = {"/cam0/image": LEFT, "/robot/joints": JOINTS}
    frames = FrameDataset([drive, other], topics=[LEFT], state=JOINTS, rename=rename)
    for row in (0, 13):
        one, two = frames[row], frames[FRAMES + row]
        assert torch.equal(one["state"], two["state"])
        assert torch.equal(one[LEFT], two[LEFT])
        assert (one["stamp_ns"], two["dataset"]) == (two["stamp_ns"], 1)


def with_joints(made: Scene, **values: Any) -> Scene:
    """Where the joints of the last messages differ."""
    last = [one for one in made.messages if one.topic == JOINTS][-1]
    changed = replace(last, values={**last.values, **values})
    messages = [changed if one is last else one for one in made.messages]
    return Scene(messages)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"state": {"/none": "position"}}, f"no messages of '/none'; there are: {ODOM}, "),
        ({"state": {JOINTS: "positions"}}, "has no field positions. Fields with numbers: header"),
        ({"state": {JOINTS: "position[thumb]"}}, "has no position[thumb] among shoulder, elbow"),
        ({"state": {JOINTS: "name"}}, "has no numbers in name"),
        ({"action": {ODOM: None}}, "nav_msgs/msg/Odometry; name its fields. Fields with numbers"),
        ({"state": {ODOM: "pose..x"}}, "the field 'pose..x', which is not like"),
        ({"state": {}}, "state is {}, not a topic"),
        ({"state": JOINTS, "message": "last"}, "message is 'last', not one of nearest, previous"),
        ({"state": JOINTS, "message_tolerance_ns": -1}, "message_tolerance_ns is -1"),
        ({"fps": 29.97}, "fps is 29.97, but must be a whole number from 1"),
        ({"episode_topic": JOINTS}, "std_msgs/String, Bool or a number"),
        ({"offsets": {"/up": (0,)}}, "offsets is given for '/up'"),
        ({"state": JOINTS, "rename": {ODOM: JOINTS}}, f"`rename` makes {JOINTS} and {ODOM} the sa"),
    ],
)
def test_wrong_options(drive: Path, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(mp4ds.OptionError) as caught:
        FrameDataset(drive, topics=[LEFT], **options)
    assert sentence in str(caught.value).replace(f"{ODOM} and {JOINTS}", f"{JOINTS} and {ODOM}")


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"name": ["a", "b", "c"]}, f"{JOINTS} has a number named a, which is not one of shoulder"),
        ({"name": [], "position": [1.0]}, f"{JOINTS} has messages of 3 and of 1 numbers"),
    ],
)
def test_messages_that_differ(tmp_path: Path, values: dict[str, Any], sentence: str) -> None:
    frames = FrameDataset(packed(tmp_path, with_joints(robot(), **values)), state=JOINTS)
    with pytest.raises(mp4ds.OptionError, match=sentence):
        frames[0]


def test_a_robot_that_was_recorded(tmp_path: Path) -> None:
    """1598 messages of 42 joints, beside a reader of bags that is not ours."""
    path = DATA / "bags/joint_states_bz2.bag"
    if not path.exists():
        pytest.skip("needs the recordings")
    mp4ds.pack(path, tmp_path / "robot")
    with mp4ds.Dataset(tmp_path / "robot") as dataset:
        fields = ["position[head_pan_joint]", "velocity"]
        found = read_vectors(dataset, "joint_states", fields)
    rows = []
    store = get_typestore(Stores.ROS1_NOETIC)
    with Reader(path) as reader:
        for connection, _, payload in reader.messages():
            message = store.deserialize_ros1(payload, connection.msgtype)
            place = message.name.index("head_pan_joint")
            rows.append([message.position[place], *message.velocity])
    assert found.names[:2] == ("position.head_pan_joint", f"velocity.{message.name[0]}")
    assert (found.values == np.array(rows, np.float32)).all()


@pytest.mark.parametrize("method", [None, "fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_in_workers_and_streams(drive: Path, method: str | None) -> None:
    frames = FrameDataset(drive, topics=[LEFT], state=JOINTS, action=COMMAND)
    samples = [frames[n] for n in range(FRAMES)]
    if method == "spawn":
        frames.load_messages()
    options: dict[str, Any] = {"batch_size": 8, "collate_fn": frames.collate}
    if method:
        options |= {"num_workers": 1, "multiprocessing_context": method}
    for number, batch in enumerate(DataLoader(frames, **options)):
        for key in ("state", "state_is_pad", "action", LEFT):
            own = [sample[key] for sample in samples[8 * number : 8 * number + 8]]
            assert torch.equal(batch[key], torch.stack(own))
    stream = FrameStream(drive, topics=[LEFT], state=JOINTS, action=COMMAND, window=8)
    found = {sample["index"]: sample for sample in stream}
    assert sorted(found) == [*range(FRAMES)]
    assert all(torch.equal(found[n]["state"], samples[n]["state"]) for n in found)


def test_samples_at_a_constant_rate(drive: Path) -> None:
    frames = FrameDataset(drive, topics=BOTH, state=JOINTS, fps=10, offsets={"state": (0, 1)})
    both = [STAMPS[topic] for topic in BOTH]
    start, end = max(stamps[0] for stamps in both), min(stamps[-1] for stamps in both)
    assert len(frames) == round((end - start) / 1e8) + 1
    (unmatched,) = frames.unmatched
    for row, sample in enumerate(frames):
        times = [start + n * 10**8 for n in (row, min(row + 1, len(frames) - 1))]
        assert abs(sample["stamp_ns"] - times[0]) == np.abs(both[0] - times[0]).min()
        found = [expected(JOINTS, time, previous=False)[0] for time in times]
        assert sample["state"].numpy() == pytest.approx(np.array(found), rel=1e-6)
        assert sample["state_is_pad"].tolist() == [False, times[0] == times[1]]
        for topic, stamps in zip(BOTH, both, strict=True):
            nearest = int(np.abs(stamps - times[0]).argmin())
            assert torch.equal(sample[topic], FrameDataset(drive, topics=[topic])[nearest][topic])
            assert nearest not in unmatched[topic]
    assert len(unmatched[LEFT]) == FRAMES - len(frames)


@pytest.mark.parametrize("unit", ["frames", "seconds"])
def test_episodes_by_a_topic(drive: Path, unit: Any) -> None:
    """Windows end with them, and nothing outside is in a sample."""
    step = 1 if unit == "frames" else PERIOD / 1e9
    frames = FrameDataset(
        drive,
        topics=[LEFT],
        episode_topic=TASK,
        offsets=(0, step),
        offsets_in=unit,
        action=JOINTS,
        action_offsets=(0, step),
    )
    assert [one.task for one in frames.recordings] == ["push", "pull"]
    assert frames.lengths == [6, 8]
    firsts = [frames[0], frames[6]]
    assert [one["stamp_ns"] for one in firsts] == [STAMPS[LEFT][3], STAMPS[LEFT][12]]
    assert [one["dataset"] for one in firsts] == [0, 1]
    last = frames[5]
    assert last[f"{LEFT}_is_pad"].tolist() == last["action_is_pad"].tolist() == [False, True]
    assert torch.equal(last[LEFT][0], last[LEFT][1])
    assert torch.equal(last["action"][0], last["action"][1])
    with pytest.raises(mp4ds.OptionError, match="no sample is in an episode"):
        FrameDataset(drive, topics=[LEFT], episode_topic="/never", rename={TASK: "/never"}, fps=1)
