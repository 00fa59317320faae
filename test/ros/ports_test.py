#!/usr/bin/python3
"""Ports that are absent, no ports at all, vanish, return elsewhere, or carry noise: the node
lives, data flows again, and nothing old is sent."""
import os
import random
import shutil
import signal
import time
import unittest

import rospy
import rostest
from rosgraph_msgs.msg import Log
from std_srvs.srv import Trigger

from boards import (ERROR, NOT_SENT, PACKAGE, SPEED_0_PACKET, SYNC_FRAME, TIMEOUT, Bridge,
                    BusBoard, CarBoard, Diagnostics, Line, Rosout, SensorBoard, Topic, Waiter,
                    command_topic, own_folder, ranges, service, until)
from serial_communication.msg import (McuStatus2, SerialMsg, SpeedPWMCommand, SteeringPWMCommand,
                                      Voltage)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.srv import BusRequest, GetEnvironment, Gimbal, Lift

LINKS = 'bus', 'arduino', 'mcu'
TRIES = 3      # of what a signal between two instructions may spoil


def setUpModule():
    """What the nodes say."""
    global ROSOUT
    ROSOUT = Rosout()


class PortsTest(unittest.TestCase):
    """A bridge with three links, and lines that a test plugs and unplugs."""

    name = PACKAGE

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        cls.lines = {link: Line(os.path.join(cls.folder, link)) for link in LINKS}
        cls.boards = {}
        parameters = {link + '/port': line.near for link, line in cls.lines.items()}
        parameters.update(cls.parameters())
        cls.bridge = Bridge(cls.name, parameters)
        cls.lift = service('/%s/lift' % cls.name, Lift)
        cls.echo = service('/%s/bus/echo' % cls.name, Trigger)
        cls.voltage = Topic('/%s/voltage' % cls.name, Voltage)
        cls.status = Topic('/mcu/status', McuStatus2)
        cls.diagnostics = Diagnostics(cls.name)

    @classmethod
    def tearDownClass(cls):
        cls.bridge.end()
        for topic in cls.voltage, cls.status, cls.diagnostics:
            topic.close()
        for board in cls.boards.values():
            board.close()
        for line in cls.lines.values():
            line.unplug()
        shutil.rmtree(cls.folder)

    @classmethod
    def parameters(cls):
        """Others than the defaults."""
        return {'bus/motion_timeout': 20.0, 'bus/environment_period': 0.0,
                'bus/reply_timeout': 0.3}

    def plug(self, *links):
        """Connect the lines, with the boards at their far ends."""
        for link in links or LINKS:
            self.lines[link].plug()
        self.wait_for_boards(*links)

    def wait_for_boards(self, *links):
        for link in links or LINKS:
            if link not in self.boards:
                self.boards[link] = {'bus': BusBoard, 'arduino': CarBoard,
                                     'mcu': SensorBoard}[link](self.lines[link].far)
            until(lambda b=self.boards[link]: b.connected, '%s board is there' % link)

    def assert_flows(self, *links):
        """New data goes through each link, from its board to ROS."""
        if 'bus' in (links or LINKS):
            until(lambda: self.lift(0, 1).success, 'the lift answers')
        if 'arduino' in (links or LINKS):
            self.voltage.next(doing=lambda: self.boards['arduino'].say(arduino.Voltage(12.0)))
        if 'mcu' in (links or LINKS):
            self.status.next(lambda m: m.connected,
                             doing=lambda: self.boards['mcu'].say(ranges()))
        self.assertTrue(self.bridge.alive)

    def unplug(self, *links):
        """Cut the lines, and wait until the bridge has noticed."""
        for link in links or LINKS:
            self.lines[link].unplug()
        self.diagnostics.fresh_of_all(links or LINKS, lambda s, _link: s.level == ERROR
                                      and 'closed' in s.message, 'a closed port')


class AbsentAtStart(PortsTest):
    """No port is there as the bridge starts."""

    def test_ports_that_come_later_are_opened_then(self):
        self.assertEqual(self.lift(0, 1).status, NOT_SENT)
        for link in LINKS:
            line = self.bridge.wait_for('%s: %s: there is no such device' % (
                link, self.lines[link].near))
            self.assertIn('WARN', line)
        self.plug()
        self.assert_flows()
        self.assertEqual(bytes(self.boards['bus'].wire[:5]), SYNC_FRAME)
        found = self.diagnostics.fresh_of_all(LINKS, lambda s, _link: s.level != ERROR, 'no error')
        self.assertEqual({s.keys['reconnects'] for s in found.values()}, {'0'})


class NoPort(PortsTest):
    """A directory stands where a port should be."""

    name = 'no_port'

    @classmethod
    def parameters(cls):
        return {'bus/port': cls.folder}

    def test_a_directory_for_a_port_is_told_and_hurts_no_other_link(self):
        self.plug('arduino', 'mcu')
        line = self.bridge.wait_for('bus: %s: this is a directory' % self.folder)
        self.assertIn('WARN', line)
        answer = self.lift(0, 1)
        self.assertEqual((answer.success, answer.status), (False, NOT_SENT))
        self.assertIn('directory', answer.message)
        self.assert_flows('arduino', 'mcu')


class Cut(PortsTest):
    """Lines that are cut, mended, and disturbed."""

    name = 'cut'

    def setUp(self):
        for link in LINKS:
            if not os.path.exists(self.lines[link].near):
                self.plug(link)
        self.boards['bus'].script.clear()
        self.assert_flows()

    def test_ports_that_vanish_and_return_carry_data_again(self):
        before = self.diagnostics.fresh_of_all(LINKS, lambda s, _link: s.level != ERROR, 'no error')
        self.unplug()
        self.assertEqual(self.lift(0, 1).status, NOT_SENT)
        self.assertFalse(self.echo().success)
        self.boards['bus'].forget()
        self.plug()
        self.assert_flows()
        self.assertEqual(bytes(self.boards['bus'].wire[:5]), SYNC_FRAME)
        self.diagnostics.fresh_of_all(LINKS, lambda s, link: int(s.keys['reconnects'])
                                      == int(before[link].keys['reconnects']) + 1,
                                      'one reconnect')

    def test_serial_msg_tells_which_connection_a_frame_belongs_to(self):
        traffic = Topic('/serial_msg', SerialMsg)
        self.addCleanup(traffic.close)

        def connection(link):
            return traffic.next(lambda m: m.link == link, doing=lambda: self.assert_flows(link)
                                ).header.frame_id
        before = {link: connection(link) for link in LINKS}
        self.assertEqual(before, {link: connection(link) for link in LINKS})
        self.unplug('mcu')
        self.plug('mcu')
        self.assertEqual(dict(before, mcu='connection %d' % (int(before['mcu'].split()[1]) + 1)),
                         {link: connection(link) for link in LINKS})

    def test_a_name_that_comes_back_as_another_device_is_found(self):
        spares = {}
        for link, line in self.lines.items():
            spares[link] = Line(line.near + '_spare').plug()
            self.assertNotEqual(os.readlink(spares[link].near), os.readlink(line.near))
        self.unplug()
        try:
            for link, line in self.lines.items():
                os.symlink(os.readlink(spares[link].far), line.far)
                os.symlink(os.readlink(spares[link].near), line.near)
            self.wait_for_boards()
            self.assert_flows()
        finally:
            for link, line in self.lines.items():
                spares[link].unplug()
                os.unlink(line.near)
                os.unlink(line.far)

    def test_a_call_that_waits_while_the_port_goes_is_a_timeout_at_once(self):
        board = self.boards['bus']
        board.forget()
        board.script.append(b'')
        waiter = Waiter(self.lift, 0, 100)
        until(lambda: board.others, 'the request is on the wire')
        cut = time.monotonic()
        self.lines['bus'].unplug()
        answer = waiter.result()
        self.assertLess(time.monotonic() - cut, 5.0)      # motion_timeout is 20 s
        self.assertEqual((answer.success, answer.status), (False, TIMEOUT))
        self.assertIn('not known', answer.message)
        board.forget()
        self.plug('bus')
        until(lambda: self.echo().success, 'the bus answers again')
        self.assertEqual(board.others, [])                # not sent again

    def test_nothing_old_is_sent_after_a_reconnect(self):
        board = self.boards['arduino']
        speed = command_topic('/cut/speed', SpeedPWMCommand)
        steering = command_topic('/cut/steering', SteeringPWMCommand)
        speed.publish(value=700)
        until(lambda: 700 in board.speeds, 'the speed is on the wire')
        self.unplug('arduino')
        speed.publish(value=500)
        steering.publish(value=1234)
        for command in 'speed 500 refused', 'steering 1234 refused':
            ROSOUT.wait_for('cut', command, Log.WARN)
        board.forget()
        self.plug('arduino')
        board.wait_for_heartbeats(80)
        self.assertTrue(set(board.raw_commands) <= {SPEED_0_PACKET}, board.raw_commands)
        steering.publish(value=1500)
        until(lambda: board.raw_commands[-1:] == [bytes.fromhex('0405dc0500')], 'new commands')

    def test_after_a_standstill_speed_0_is_first_and_nothing_old_is_sent(self):
        """SIGSTOP for 5 s while the car drives and ten commands without a stamp are sent."""
        board = self.boards['arduino']
        speed = command_topic('/cut/speed', SpeedPWMCommand)
        steering = command_topic('/cut/steering', SteeringPWMCommand)
        # The signal may come between the decision to send a heartbeat and its write: that one
        # then leaves first, which nothing in the process can exclude, and SPEED 0 is next.
        for _ in range(TRIES):
            self.stand_still(speed, steering)
            self.assertTrue(set(board.raw_commands) <= {SPEED_0_PACKET}, board.raw_commands)
            self.assertIn(SPEED_0_PACKET, board.raws[:2])
            if board.raws[0] == SPEED_0_PACKET:
                break
        self.assertEqual(board.raws[0], SPEED_0_PACKET)
        ROSOUT.wait_for('cut', ' s: SPEED 0 is sent first', Log.WARN)
        until(lambda: 250 in board.speeds, 'new commands', doing=lambda: speed.publish(value=250),
              every=0.05)

    def stand_still(self, speed, steering):
        """Afterwards the board's records begin with what came as the bridge went on."""
        board = self.boards['arduino']
        until(lambda: 700 in board.speeds, 'the car drives',
              doing=lambda: speed.publish(value=700), every=0.05)
        speed.publish(value=701)        # the last one, behind all others
        until(lambda: 701 in board.speeds, 'no command is under way')
        process = self.bridge.process
        process.send_signal(signal.SIGSTOP)
        os.waitpid(process.pid, os.WUNTRACED)
        time.sleep(0.2)         # what had left before is with the board
        board.forget()
        for number in range(10):
            time.sleep(0.5)
            speed.publish(value=300 + number)
            steering.publish(value=1000 + number)
        self.assertEqual(board.frames, [])
        process.send_signal(signal.SIGCONT)
        board.wait_for_heartbeats(60)

    def test_what_moves_is_not_sent_if_it_was_called_while_the_bridge_stood_still(self):
        """SIGSTOP; the calls wait in connections that exist already."""
        proxies = {'lift': rospy.ServiceProxy('/cut/lift', Lift, persistent=True),
                   'gimbal': rospy.ServiceProxy('/cut/gimbal', Gimbal, persistent=True),
                   'request': rospy.ServiceProxy('/cut/bus/request', BusRequest, persistent=True),
                   'reading': rospy.ServiceProxy('/cut/get_environment', GetEnvironment,
                                                 persistent=True)}
        arguments = {'lift': (0, 100), 'gimbal': (1, 30), 'request': (0x55, 0x30, b''),
                     'reading': ()}
        for name, proxy in proxies.items():
            self.addCleanup(proxy.close)
            until(lambda n=name, p=proxy: p(*arguments[n]).success, name)
        board = self.boards['bus']
        board.forget()
        process = self.bridge.process
        process.send_signal(signal.SIGSTOP)
        os.waitpid(process.pid, os.WUNTRACED)
        sent = {name: proxy.transport.stat_bytes for name, proxy in proxies.items()}
        waiters = {name: Waiter(proxy, *arguments[name]) for name, proxy in proxies.items()}
        until(lambda: all(proxy.transport.stat_bytes > sent[name]
                          for name, proxy in proxies.items()), 'the calls are under way')
        stopped = time.monotonic()
        until(lambda: time.monotonic() > stopped + 1.0, 'a stall')
        process.send_signal(signal.SIGCONT)
        answers = {name: waiter.result() for name, waiter in waiters.items()}
        self.assertTrue(answers.pop('reading').success)
        for name, answer in answers.items():
            self.assertEqual((answer.success, answer.status), (False, NOT_SENT), name)
            self.assertEqual(answer.message,
                             'it may have waited while the bridge stalled; nothing was sent')
        self.assertEqual(set(board.others), {bus.encode_request(bus.ENVIRONMENT_REQUEST)})
        until(lambda: proxies['lift'](0, 100).success, 'the lift moves again')

    def test_noise_on_every_line_is_counted_and_good_frames_still_come(self):
        before = self.diagnostics.fresh_of_all(LINKS, lambda s, _link: True, 'any level')
        noise = random.Random(7)
        for _ in range(30):
            for board in self.boards.values():
                board.write(bytes(noise.randrange(256) for _ in range(100)))
        self.diagnostics.fresh_of_all(LINKS, lambda s, link: int(s.keys['framing errors'])
                                      > int(before[link].keys['framing errors']),
                                      'more framing errors')
        self.boards['arduino'].write(b'\0')      # ends what noise has begun
        self.assert_flows()
        noisy = bytes(noise.randrange(256) for _ in range(20))
        self.boards['bus'].script.append(lambda request: noisy + bus.encode_reply(
            bus.Reply(bus.OK)))
        self.assertTrue(self.lift(0, 2).success)
        self.boards['mcu'].write(noisy)
        self.assert_flows()
        self.assertLess(len(ROSOUT.lines('cut', 'bus: framing:')), 5)


if __name__ == '__main__':
    rospy.init_node('ports_test')
    rostest.rosrun(PACKAGE, 'ports', '__main__')
