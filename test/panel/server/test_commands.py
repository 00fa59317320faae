"""What the commands of the pages do when something is missing, without a panel and without ROS."""
import threading
import time
from unittest import mock

import pytest
import rospy
from std_srvs.srv import SetBoolResponse

from waiting import PATIENCE, until
from serial_communication.boards.arduino.wire import SPEED_LIMIT
from serial_communication.tools.panel import commands as panel_commands
from serial_communication.tools.panel.commands import Commands
from serial_communication.tools.panel.dead_man import SILENCE, CommandRefused
from serial_communication.tools.watch.calls import Answer, Verdict

NODE = '/serial_communication'
PAGE = 'a page'
DONE = SetBoolResponse(True, 'stopped')


class Panel:
    """The commands with publishers of this test; `later` has what is to be called later."""

    def __init__(self):
        self.later = []
        self.commands = Commands(NODE, mock.Mock(), lambda call, *given: call(*given),
                                 lambda *given: self.later.append(given))
        self.commands.start()
        self.speed, self.steering = mock.Mock(), mock.Mock()
        self.commands._publishers = {'~speed': self.speed, '~steering': self.steering}

    def drive(self, reached):
        """Take a command of a page while the bridge subscribes to these."""
        for publisher in self.speed, self.steering:
            publisher.impl.has_connection.return_value = publisher in reached
        with mock.patch.object(rospy.Time, 'now', rospy.Time):
            self.commands.drive(PAGE, 1, time.monotonic(), SPEED_LIMIT, 1500)

    @property
    def calls(self):
        """The answers to calls, by the keys of the page."""
        return {call['key']: call for call in self.commands.snapshot()['calls']}


@pytest.fixture
def panel():
    return Panel()


@pytest.mark.parametrize('missing', ['speed', 'steering'])
def test_nothing_is_published_unless_the_bridge_takes_speed_and_steering(panel, missing):
    reached = [panel.steering if missing == 'speed' else panel.speed]
    with pytest.raises(CommandRefused, match=f'does not subscribe to ~{missing}'):
        panel.drive(reached)
    assert not panel.speed.publish.called and not panel.steering.publish.called
    assert not panel.commands.stop_driving()


@pytest.mark.parametrize('fails', ['speed', 'steering'])
def test_silence_stops_the_car_even_if_the_first_command_could_not_be_published(panel, fails):
    getattr(panel, fails).publish.side_effect = MemoryError
    with pytest.raises(MemoryError):
        panel.drive([panel.speed, panel.steering])
    (after, check), = panel.later
    assert after == SILENCE
    panel.speed.publish.side_effect = None
    with mock.patch.object(time, 'monotonic', return_value=time.monotonic() + SILENCE), \
            mock.patch.object(rospy.Time, 'now', rospy.Time):
        check()
    assert panel.speed.publish.call_args[0][0].value == 0
    assert not panel.commands.stop_driving()


def press_stop(panel, answer):
    """Press STOP, to which the bridge answers with what `answer()` returns; return the call."""
    called = []

    def call(name, _service_class, request, _deadline):
        called[:] = name, request.data
        return answer()

    with mock.patch.object(panel_commands, 'call', call), \
            mock.patch.object(rospy.Time, 'now', rospy.Time):
        panel.commands.press_stop('1')
        until(lambda: called, '~stop is called')
    return called


def speeds(panel):
    """The speeds that were published."""
    return [call[0][0].value for call in panel.speed.publish.call_args_list]


def test_stop_ends_a_hold_and_calls_the_bridge(panel):
    panel.drive([panel.speed, panel.steering])
    called = press_stop(panel, lambda: Answer(Verdict.DONE, 'stopped', DONE))
    assert called == [f'{NODE}/stop', True]
    until(lambda: panel.calls['1'].get('outcome') == 'done', 'it is answered')
    after, fall_back, stop = panel.later[-1]
    fall_back(stop)
    assert after == 0.5 and speeds(panel) == [SPEED_LIMIT, 0]


def test_a_stop_without_an_answer_or_refused_sends_speed_0(panel):
    answer = threading.Event()
    press_stop(panel, lambda: answer.wait(PATIENCE) and Answer(Verdict.REFUSED, 'not sent'))
    _after, fall_back, stop = panel.later[-1]
    assert not speeds(panel)
    with mock.patch.object(rospy.Time, 'now', rospy.Time):
        fall_back(stop)
        assert speeds(panel) == [0]
        answer.set()
        until(lambda: len(speeds(panel)) == 2, 'it is sent again when the call fails')
