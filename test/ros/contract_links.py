"""serial_msg, diagnostics, ports that vanish, reset, lending, and the programs beside a bridge."""
import os
import re
import signal
import sys
from math import hypot

import rospy
from geometry_msgs.msg import Vector3Stamped
from std_srvs.srv import Empty, Trigger

from boards import (ERROR, OK, PACKAGE, SPEED_0_PACKET, SYNC_FRAME, WARN, Process, program,
                    settle, until)
from by_definition import VOLTAGE, arduino_packet, mcu_frame
from contract_robot import LINKS, Contract, pack
from serial_communication.boards.arduino import wire as arduino
from serial_communication.msg import McuStatus2, SerialMsg, SpeedPWMCommand, Voltage
from serial_communication.srv import Lift, Release

KEYS = {'port', 'state', 'condition', 'frames received', 'frames sent', 'bytes received',
        'bytes sent', 'checksum errors', 'framing errors', 'reconnects', 'last frame age [s]'}
OWN_KEYS = {'bus': {'timeouts', 'round trip p50 [ms]', 'round trip max [ms]', 'firmware',
                    'announced'},
            'arduino': {'heartbeats sent', 'heartbeat max gap [ms]'},
            'mcu': {'frames lost'}, 'wind': set()}
GUST = b'$WIMWV,090.0,R,012.5,M,A*2F\r\n'      # checked by hand: the XOR of all between $ and *
# Of speed and cmd_vel.
ZEROS = SPEED_0_PACKET + arduino_packet(205, bytes(4))
# A command that has the port open until SIGUSR1.
BORROW = '''
import serial, signal, sys, time
signal.signal(signal.SIGUSR1, lambda *_: sys.exit())
port = serial.Serial(sys.argv[1], 57600, timeout=0.05)
print('open', flush=True)
time.sleep(600)
'''


class Traffic(Contract):
    """serial_msg."""

    def test_it_has_every_frame_in_and_out_bad_ones_too(self):
        frames, RX, TX = self.topic('serial_msg', SerialMsg), SerialMsg.RX, SerialMsg.TX
        speed = self.command('~speed', SpeedPWMCommand)
        lift = self.service('~lift', Lift)
        bad = b'\x02\x03\x20\x07\x09\xff\x03'       # its CRC would be 0x2e
        for doing, link, direction, type_, command, data, frame, text in (
                (lambda: speed.publish(value=400), 'arduino', TX, 4, 0, b'\x90\1',
                 bytes.fromhex('0404900100'), 'speed 400'),
                (lambda: self.car.say(arduino.LOGS[2]('hot')), 'arduino', RX, 2, 0, b'hot\0',
                 arduino_packet(2, b'hot\0'), 'hot'),
                (lambda: self.car.write(arduino_packet(32, pack('h', 250))), 'arduino', RX, 32, 0,
                 pack('h', 250), arduino_packet(32, pack('h', 250)), 'force data=2.5'),
                (lambda: self.car.write(arduino_packet(34, b'\5\0\6\0')), 'arduino', RX, 34, 0,
                 b'\5\0\6\0', arduino_packet(34, b'\5\0\6\0'), 'line_sensors data=[5 6]'),
                (lambda: lift(0, 100), 'bus', TX, 0x55, 0x20, b'\0d',
                 bytes.fromhex('a50255200064b6'), 'lift up 100 mm'),
                (None, 'bus', RX, 2, 0, b'', bytes.fromhex('a50002a7'), 'OK'),
                (lambda: self.sensors.write(mcu_frame(0x20, 201, b'\x10\0')), 'mcu', RX, 0x20, 201,
                 b'\x10\0', mcu_frame(0x20, 201, b'\x10\0'), 'cliff range=0.016'),
                (lambda: self.wind(GUST), 'wind', RX, 0, 0, b'', GUST,
                 'wind from 90 degrees, 12.5 m/s')):
            began = rospy.Time.now()
            found = frames.first(lambda m, f=frame, li=link: (m.link, bytes(m.frame)) == (li, f),
                                 doing=doing, what=f'has {text}')
            if link != 'wind':
                self.assertEqual((found.type, found.command, bytes(found.data)),
                                 (type_, command, data))
            self.assertEqual((found.direction, found.error), (direction, ''))
            self.assertRegex(found.text, r'\A.*\b' + re.escape(text) + r'.*\Z')
            self.assertTrue(doing is None or began <= found.header.stamp <= rospy.Time.now())
        found = frames.first(lambda m: bytes(m.frame) == bad, doing=lambda: self.sensors.write(bad))
        self.assertTrue(found.error.startswith('checksum'), found.error)

    def wind(self, data):
        """Send this to the link of the board of another package."""
        with open(self.robot.lines['wind'].far, 'wb', buffering=0) as board:
            board.write(data)


class Diagnostics(Contract):
    """/diagnostics, and ports that vanish and return."""

    def test_each_link_has_one_status_a_second_with_every_key(self):
        for link in LINKS:
            port = self.robot.lines[link].near
            status = self.diagnostics.wait_for(link, lambda s, w=link == 'wind': w or s.level == OK,
                                               'OK')
            self.assertEqual((status.hardware_id, status.keys['port']), (port, port))
            self.assertEqual((KEYS | OWN_KEYS[link]) - set(status.keys), set(), link)
            if link != 'wind':
                self.assertEqual(status.keys['condition'], 'ok')
        until(lambda: len(self.diagnostics.statuses('wind')) >= 3, 'three statuses')
        stamps = [each.stamp for each in self.diagnostics.statuses('wind')]
        self.assertGreater(stamps[-1] - stamps[0], len(stamps) - 2.1, stamps)
        names = {s.name for m in self.diagnostics.messages for s in m.status}
        self.assertLessEqual({f'{PACKAGE}: {link} link' for link in LINKS}, names)

    def test_errors_of_the_last_second_are_a_warning(self):
        def noise():
            self.robot.bus.write(b'\x11' * 8)
        status = self.diagnostics.wait_for('bus', lambda s: s.level == WARN, 'a warning', noise)
        self.assertGreater(int(status.keys['framing errors']), 0)

    def test_ports_that_vanish_are_errors_and_data_flows_again_when_they_return(self):
        before = {link: self.reconnects(link) for link in LINKS}
        settled, voltage = self.topic('mcu/status', McuStatus2), self.topic('~voltage', Voltage)
        with self.unplugged(*LINKS) as statuses:
            self.assertEqual({status.level for status in statuses}, {ERROR})
            self.car.forget()
            self.bus.forget()
        until(lambda: self.service('~lift', Lift)(0, 1).success, 'the lift answers')
        self.assertEqual(bytes(self.bus.wire[:5]), SYNC_FRAME)
        packet = arduino_packet(VOLTAGE, pack('f', 14.5))
        voltage.next(lambda m: m.value == 14.5, doing=lambda: self.car.write(packet))
        self.assertEqual(bytes(self.car.wire).lstrip(b'\0')[:5], SPEED_0_PACKET)
        settled.next(lambda m: m.connected)
        self.assertEqual({link: self.reconnects(link) - before[link] for link in LINKS},
                         dict.fromkeys(LINKS, 1))


class Lending(Contract):
    """~LINK/reset, ~LINK/release and the program release."""

    def setUp(self):
        super().setUp()
        self.speed = self.command('~speed', SpeedPWMCommand)
        until(lambda: self.car.motor_on, 'it drives',
              doing=lambda: self.speed.publish(value=300))

    def lend(self, seconds, by='arduino-cli'):
        """Call the service until it succeeds; it refuses after a stall of this machine."""
        release = self.service('~arduino/release', Release)
        return until(lambda: next((a for a in [release(by, seconds)] if a.success), None),
                     'the port is lent', every=0.1)

    def release(self, *command, link='arduino'):
        """Start the program `release`."""
        process = Process(program('release'), link, *command)
        self.addCleanup(process.kill)
        return process

    def assert_lent(self, by):
        """The zeros were the last packets, nothing follows, and the link is lent to this one."""
        until(lambda: self.car.wire.endswith(ZEROS), 'the zeros are the last packets')
        self.car.forget()
        self.diagnostics.wait_for('arduino', lambda s: s.level == WARN and s.keys['condition']
                                  == 'lent' and by in s.message, f'lent to {by}')
        self.assertEqual(bytes(self.car.wire), b'')

    def assert_back(self):
        """The first packet is SPEED 0, and heartbeats follow."""
        until(lambda: self.car.heartbeats() > 3, 'heartbeats')
        self.assertEqual(bytes(self.car.wire).lstrip(b'\0')[:5], SPEED_0_PACKET)

    def test_a_pty_cannot_be_reset(self):
        for link in LINKS:
            self.assertFalse(self.service(f'~{link}/reset', Trigger)().success)

    def test_the_service_lends_and_takes_back(self):
        self.assertEqual(self.lend(10.0).message, 'lent to arduino-cli')
        self.assert_lent('arduino-cli')
        self.assert_service_error('lent to arduino-cli', self.service('~calibrate_imu', Empty))
        self.assertFalse(self.service('~arduino/release', Release)('minicom', 5.0).success)
        self.lend(0.0)
        self.assert_back()
        before = self.reconnects('arduino')
        self.lend(0.5)      # it ends by itself
        until(lambda: self.reconnects('arduino') > before, 'the port is opened again')

    def borrow(self):
        """Start a program that borrows the port; return it, and the process that has it open.

        It ends after a stall of this machine.
        """
        def borrows():
            process = self.release('--', sys.executable, '-c', BORROW, '{port}')
            until(lambda: '\n' in process.output(), 'it says something')
            return process if process.output() == 'open\n' else print(process.output())
        process = until(borrows, 'the port is lent')
        with open(f'/proc/{process.process.pid}/task/{process.process.pid}/children') as file:
            return process, int(file.read())

    def test_a_command_borrows_the_port_and_gives_it_back(self):
        process, command = self.borrow()
        began = rospy.Time.now().to_sec()
        self.assert_lent(f'python3 (pid {process.process.pid})')
        # A loan of `release` that is not renewed has ended after 6 s.
        self.diagnostics.wait_for('arduino', lambda s: s.stamp > began + 6, 'a later time')
        self.assertEqual(bytes(self.car.wire), b'')
        os.kill(command, signal.SIGUSR1)
        self.assertEqual(process.ended(), 0, process.output())
        self.assert_back()

    def test_a_loan_of_a_program_that_is_killed_runs_out(self):
        process, command = self.borrow()
        self.assert_lent('python3')
        process.kill()
        until(lambda: not os.path.exists(f'/proc/{command}'), 'its command is killed, too')
        self.assert_back()

    def test_the_exit_status_is_the_commands_and_what_cannot_be_done_is_said(self):
        for status, arguments in (
                (3, ['--', 'sh', '-c', 'exit 3']), (137, ['--', 'sh', '-c', 'kill -9 $$']),
                (127, ['--', 'nothing-there']), (125, ['--node', 'other', '--', 'true'])):
            process = self.release(*arguments)
            self.assertEqual(process.ended(), status, process.output())
        self.lend(10.0, 'me')
        process = self.release('--', 'true')
        until(lambda: self.lend(10.0, 'me') and not process.alive, 'it gives up')
        self.assertEqual(process.ended(), 125)
        self.assertIn('lent to me', process.output())
        self.lend(0.0, 'me')


class Programs(Contract):
    """The monitor, and the board of another package with every program."""

    def run_program(self, *command):
        """Run a program; return its exit status and output."""
        process = Process(program(command[0]), *command[1:], PYTHONPATH=self.robot.python_path)
        self.addCleanup(process.kill)
        return process.ended(), process.output()

    def simulate_wind(self):
        """Start the simulator of the other package's board."""
        process = Process(program('simulator'), 'wind_sensor', '--port',
                          self.robot.lines['wind'].far, '--faults', 'drop=0.1', '--seed', '1',
                          PYTHONPATH=self.robot.python_path)
        self.addCleanup(process.kill)

    def test_monitor_once_is_0_if_every_link_is_ok_and_1_if_one_is_not(self):
        self.simulate_wind()
        settle(PACKAGE, self.bus)

        def shown(*arguments):
            """The table with values. On a busy machine the heartbeat is late: that is a warning."""
            status, said = self.run_program('monitor', '--once', *arguments)
            levels = re.findall(rf'(?m)^(?:{"|".join(LINKS)}) +([A-Z]+) ', said)
            self.assertEqual(len(levels), len(LINKS), said)
            self.assertEqual(status == 0, set(levels) == {'OK'}, said)
            return said if all(re.search(each, said, re.MULTILINE) for each in (
                r'^~voltage +[\d.]+ Hz  8\.\d\d V$', r'^wind +[\d.]+ Hz  vector')) else ''
        until(shown, 'it has the values')
        said = until(lambda: shown('--report'), 'the report has the values')
        self.assertIn(f"\n    port: {self.robot.lines['bus'].near}\n", said)
        self.assertRegex(said, r'(?m)^    checksum errors: \d+$')
        with self.unplugged('bus'):
            status, said = self.run_program('monitor', '--once')
        self.assertEqual(status, 1, said)
        self.assertRegex(said, r'(?m)^bus +ERROR ')
        status, said = self.run_program('monitor', '--once', '--node', '/robot/absent')
        self.assertEqual(status, 1)
        self.assertIn('/robot/absent', said)

    def test_a_board_of_another_package_works_like_the_built_in_ones(self):
        wind = self.topic('wind', Vector3Stamped)
        self.simulate_wind()
        message = wind.first(lambda m: abs(hypot(m.vector.x, m.vector.y) - 5) < 1e-6)
        self.assertEqual(message.header.frame_id, 'robot/wind')
        config = f'{self.robot.folder}/wind.yaml'
        status, said = self.run_program('wire', 'explain', 'wind', '--config', config, GUST.hex())
        self.assertEqual(status, 0, said)
        self.assertIn('wind from 90 degrees, 12.5 m/s', said)
        self.assertEqual(re.findall(r'(?m)^  (?:[0-9a-f]{2} )+ +([a-z]+)', said), ['frame'])
        status, said = self.run_program('wire', 'explain', 'wind_sensor', GUST.hex()[:-8])
        self.assertEqual(status, 1)
        self.assertIn('framing', said)


class End(Contract):
    """The end of the bridge, after all of that."""

    def test_it_ends_in_order_and_nothing_was_a_fault(self):
        self.assertEqual(self.robot.bridge.end(), 0)
        self.assertNotIn('Traceback', self.robot.bridge.output())
