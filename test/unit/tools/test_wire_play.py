"""wire play: the whole frames of a bag, or of what listen printed, at their intervals."""
import subprocess
import sys
import time
from datetime import datetime, timedelta

import pytest
import rosbag
import rospy
from lines import ROOT, Pty
from serial_communication.boards.mcu import wire as mcu
from serial_communication.msg import SerialMsg
from serial_communication.tools.wire import play
from waiting import PATIENCE
from wire_lines import settings

PROGRAM = [sys.executable, ROOT + '/scripts/wire']


def status(number):
    return mcu.encode(mcu.SensorStatus(number, 500, 30.0, 4.0, 5.0), number)


CRC = status(4)[:-2] + b'\x00\x03'
UNKNOWN = mcu.encode_raw(9, 5, b'\1\2')
FRAMES = [(0.0, status(0)), (0.02, status(1)), (0.02, CRC), (0.03, b'\x11\x22'),
          (0.04, status(2)[:9]), (0.35, status(3)), (0.36, UNKNOWN)]
WHOLE = [status(0), status(1), status(3), UNKNOWN]


@pytest.fixture
def far(tmp_path):
    one = Pty(tmp_path / 'board').plug()
    yield one
    one.unplug()


def bag_of(path, frames, topic='/serial_msg', began=1763769600.5):
    with rosbag.Bag(str(path), 'a' if path.exists() else 'w') as bag:
        for number, (at, frame) in enumerate(frames, 1):
            for link, direction in (('mcu', 0), ('mcu', 1), ('bus', 0)):
                message = SerialMsg(link=link, direction=direction, frame=frame)
                message.header.stamp = rospy.Time.from_sec(began + at)
                bag.write(topic, message, rospy.Time(number))
    return path


def printed(path, frames):
    began = datetime(2026, 1, 1, 23, 59, 59, 900000)
    lines = [f'{began + timedelta(seconds=at):%H:%M:%S.%f}  {"+20.00 ms" if at else "":>12}  '
             f'{frame.hex(" "):48}  sensor status range_1=1 +2 s' for at, frame in frames]
    path.write_text('\n'.join(['/dev/ttyUSB0: open', *lines]) + '\n')
    return path


def run(*arguments):
    return subprocess.run(PROGRAM + ['play', *map(str, arguments)], timeout=PATIENCE, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@pytest.mark.parametrize('recording', [bag_of, printed])
def test_the_whole_frames_of_the_board_are_sent_at_their_intervals(recording, tmp_path, far):
    file = recording(tmp_path / 'recording', FRAMES)
    began = time.monotonic()
    done = run(file, 'mcu', far.path)
    assert (done.returncode, done.stdout) == (0, '') and time.monotonic() - began > 0.36
    assert done.stderr == '4 frames; 3 invalid ones are left out\n'
    assert far.read_all() == b''.join(WHOLE)


def test_a_file_that_cannot_be_played_is_reported_in_one_line(tmp_path):
    (tmp_path / 'text').write_text('hello\n')
    several = bag_of(tmp_path / 'several', FRAMES)
    bag_of(several, FRAMES, '/robot/serial_msg')
    whole = bag_of(tmp_path / 'whole', FRAMES).read_bytes()
    (tmp_path / 'half').write_bytes(whole[:len(whole) // 2])
    for name, words in (('text', 'no frames of the link mcu'), ('missing', 'No such file'),
                        ('', 'Is a directory'), ('several', 'rosbag filter'),
                        ('half', 'cannot be read')):
        done = run(tmp_path / name, 'mcu', '/dev/null')
        assert done.returncode == 1 and words in done.stderr, name
        assert len(done.stderr.splitlines()) == 1
    assert play.whole([(0.0, b'\x11')], settings('mcu')) == []
