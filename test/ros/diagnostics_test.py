#!/usr/bin/python3
"""/diagnostics: names, keys, and levels."""
import unittest

import rospy
import rostest

from boards import (ERROR, OK, PACKAGE, PATIENCE, WARN, BusBoard, CarBoard, Diagnostics,
                    SensorBoard, level_imu, ranges, settle, until)

LINKS = 'bus', 'arduino', 'mcu'
KEYS = {'port', 'state', 'frames received', 'frames sent', 'bytes received', 'bytes sent', 'stale',
        'checksum errors', 'framing errors', 'reconnects', 'last frame age [s]'}
OWN_KEYS = {'bus': {'timeouts', 'round trip p50 [ms]', 'round trip max [ms]'},
            'arduino': {'heartbeats sent', 'heartbeat gap [ms]', 'heartbeat max gap [ms]'},
            'mcu': {'frames lost'}}
NOISE = {'bus': bytes.fromhex('112233'), 'arduino': bytes.fromhex('ff010200'),
         'mcu': bytes.fromhex('112233')}
BAD_CHECKSUM = {'bus': bytes.fromhex('a50002a6'),
                'mcu': bytes.fromhex('020c1001010002000300040005000003')}


def setUpModule():
    """Start the three boards, and record all statuses."""
    global LINE, BOARDS, RECORD
    LINE = rospy.get_param('~line')
    BOARDS = {'bus': BusBoard(LINE + '_bus_board', polled=True),
              'arduino': CarBoard(LINE + '_arduino_board'),
              'mcu': SensorBoard(LINE + '_mcu_board')}
    RECORD = Diagnostics()


def number(status, key):
    """The value of a key, as a number."""
    return float(status.keys[key])


class DiagnosticsTest(unittest.TestCase):
    """Three boards that send data, and a subscriber of the statuses."""

    def setUp(self):
        settle(PACKAGE, BOARDS['bus'])
        self.diagnostics = Diagnostics()

    def tearDown(self):
        self.diagnostics.close()

    @staticmethod
    def talk():
        """Send a message from each board that sends without a request."""
        BOARDS['arduino'].say(level_imu())
        BOARDS['mcu'].say(ranges())

    def fresh(self, link, condition, what, doing=None):
        """Wait for the first such status of one link from now on, while all boards send."""
        return self.diagnostics.fresh(link, condition, what, doing or self.talk)

    def fresh_of_all(self, level, links=LINKS, doing=None):
        """Wait for a status of each link at that level from now on, while all boards send."""
        return self.diagnostics.fresh_of_all(links, lambda s, _link: s.level == level,
                                             'level %d' % level, doing or self.talk)

    def test_each_link_has_one_status_with_every_key_and_its_port_as_hardware_id(self):
        for link, status in self.fresh_of_all(OK).items():
            self.assertEqual(status.hardware_id, '%s_%s' % (LINE, link))
            self.assertEqual(status.keys['port'], status.hardware_id)
            self.assertEqual((KEYS | OWN_KEYS[link]) - set(status.keys), set(), link)
            self.assertTrue(status.message)
        names = {s.name for m in self.diagnostics.messages for s in m.status
                 if s.name.startswith(PACKAGE)}
        self.assertEqual(names, {'serial_communication: %s link' % link for link in LINKS})

    def test_each_status_is_published_once_a_second(self):
        for link in LINKS:
            # At least every two seconds …
            until(lambda name=link: len(RECORD.statuses(name)) >= 8, 'eight statuses')
            # … and at most every second; only the first may have been late.
            times = [status.stamp for status in RECORD.statuses(link)]
            self.assertLess(times[-1] - times[-8], PATIENCE)
            self.assertGreater(times[-1] - times[0], len(times) - 2.1, times)

    def test_links_with_traffic_are_ok_and_count_frames_and_bytes(self):
        first, later = self.fresh_of_all(OK), self.fresh_of_all(OK)
        for link in LINKS:
            for key in ('frames received', 'bytes received') + (
                    ('frames sent', 'bytes sent') if link != 'mcu' else ()):
                self.assertGreater(number(later[link], key), number(first[link], key), link)
            self.assertLess(number(later[link], 'last frame age [s]'), 1.0)
            self.assertEqual(later[link].keys['reconnects'], '0')
            self.assertTrue(later[link].keys['state'])
        self.assertEqual(later['mcu'].keys['bytes sent'], '0')
        self.assertGreater(number(later['arduino'], 'heartbeats sent'),
                           number(first['arduino'], 'heartbeats sent'))
        self.assertGreater(number(later['arduino'], 'heartbeat max gap [ms]'), 5.0)
        p50, most = (number(later['bus'], 'round trip %s [ms]' % key) for key in ('p50', 'max'))
        self.assertTrue(0.0 < p50 <= most < 1000.0, (p50, most))

    def test_errors_in_the_last_second_are_a_warning_and_are_counted_by_cause(self):
        for key, damage in ('framing errors', NOISE), ('checksum errors', BAD_CHECKSUM):
            before = self.fresh_of_all(OK)
            for link in damage:
                BOARDS[link].write(damage[link])
            after = self.diagnostics.fresh_of_all(
                damage, lambda s, name: s.level == WARN and number(s, key)
                == number(before[name], key) + 1, 'WARN and one more of the ' + key, self.talk)
            self.assertEqual(set(after), set(damage))
        self.fresh_of_all(OK)

    def test_a_closed_port_is_an_error(self):
        closed = Diagnostics('closed')
        found = closed.wait_for_all(LINKS, lambda s, _link: 'no such device' in s.message,
                                    'no device')
        for link, status in found.items():
            self.assertEqual(status.level, ERROR)
            self.assertEqual(status.hardware_id, '%s_absent_%s' % (LINE, link))
            self.assertEqual((KEYS | OWN_KEYS[link]) - set(status.keys), set(), link)
            self.assertEqual(status.keys['frames received'], '0')
        closed.close()


if __name__ == '__main__':
    rospy.init_node('diagnostics_test')
    rostest.rosrun(PACKAGE, 'diagnostics', '__main__')
