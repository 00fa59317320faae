#!/usr/bin/python3
"""The master fails while a bridge starts, while one of its boards announces rows, or while it runs.
The campaign replaces the master of a bridge that runs, too."""
import socket
import socketserver
import threading
import time
import xmlrpc.client
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

import rosgraph
import rostest

from boards import PACKAGE, PATIENCE, BoardsTest, BusBoard, CarBoard, until
from serial_communication.framing.announcement import chunks_of

WITHIN = 10.0         # s in which the bridge must register at a new master
ROW = b'force: {type: 32, ros_type: std_msgs/Float32, layout: "<h", fields: [data]}'


def state(server, node):
    """Return a node's topics, subscriptions and services; none if the master does not answer."""
    try:
        return [{name for name, nodes in entries if node in nodes}
                for entries in server.getSystemState()]
    except (rosgraph.MasterException, OSError):
        return [set()] * 3


class MasterInBetween:
    """A ROS master that passes every call on to the test's own, and fails as the test wants.

    Args:
        answered: called with the method and the arguments of each call, after the master has
            answered; returns True to close the connection without an answer.
    """

    def __init__(self, answered):
        self._away_until = 0.0      # by time.monotonic()
        self.master = rosgraph.get_master_uri()     # that is called
        between = self

        class Server(socketserver.ThreadingMixIn, SimpleXMLRPCServer):
            daemon_threads = True

            def verify_request(self, request, client_address):
                return time.monotonic() >= between._away_until

        class Handler(SimpleXMLRPCRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers['Content-Length']))
                arguments, method = xmlrpc.client.loads(body)
                with xmlrpc.client.ServerProxy(between.master) as master:
                    try:
                        answer = xmlrpc.client.dumps((getattr(master, method)(*arguments),),
                                                     methodresponse=True)
                    except xmlrpc.client.Fault as fault:
                        answer = xmlrpc.client.dumps(fault)
                if answered(method, arguments):
                    self.close_connection = True
                    return
                data = answer.encode()
                self.send_response(200)
                self.send_header('Content-Type', 'text/xml')
                self.send_header('Content-Length', str(len(data)))
                self.end_headers()
                self.wfile.write(data)

        self._server = Server(('localhost', 0), Handler, logRequests=False)
        self.uri = 'http://localhost:%d' % self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()

    def is_away_for(self, seconds):
        """Close every new connection at once, for a time."""
        self._away_until = time.monotonic() + seconds

    def close(self):
        """End it."""
        self._server.shutdown()
        self._server.server_close()


class MasterTest(BoardsTest):
    """A car, and masters beside rostest's."""

    def setUp(self):
        super().setUp()
        self.car = self.plug('arduino', CarBoard)
        self.server = rosgraph.Master('/master_test')
        self.bridge = None

    def announce(self):
        """Announce the row until it is in use."""
        until(lambda: 'announces force' in self.bridge.output(), 'the row is in use', every=0.2,
              doing=lambda: [self.car.say(chunk) for chunk in chunks_of(ROW, 50)])

    def is_up(self, name):
        """Whether the last of the bridge's services is registered."""
        return f'/{name}/calibrate_imu' in state(self.server, f'/{name}')[2]

    def assert_ends(self):
        seconds, status = self.bridge.end()
        self.assertEqual(status, 0, self.bridge.output())
        self.assertNotIn('Traceback', self.bridge.output())
        return seconds


class StartTest(MasterTest):
    """A master that fails while the bridge starts."""

    def start(self, name, answered):
        """Start a bridge whose port is a parameter of its command line."""
        self.master = MasterInBetween(answered)
        self.addCleanup(self.master.close)
        self.bridge = self.start_bridge(
            name, arguments=['_arduino/port:=' + self.lines['arduino'].near],
            master=self.master.uri)

    def assert_it_works(self, name):
        """The bridge has its port and all its names."""
        until(lambda: not self.bridge.alive or self.is_up(name), 'the bridge is up')
        self.assertTrue(self.bridge.alive, self.bridge.output())
        self.car.wait_for_heartbeats(1)
        self.assert_ends()
        self.assertNotIn('no port is set (', self.bridge.output())

    def test_a_master_that_ends_at_any_call_of_the_start_is_waited_for(self):
        ended_at = []

        def answered(method, arguments):
            """End, for a moment, at the first call of each kind; its answer is lost."""
            call = method, str(arguments[1:2])
            if call in ended_at or not self.bridge:     # not the bridge's
                return False
            ended_at.append(call)
            self.master.is_away_for(0.25)
            return True

        self.start('ended', answered)
        self.assert_it_works('ended')
        methods = {method for method, _ in ended_at}
        self.assertLessEqual({'setParam', 'getParam', 'registerPublisher', 'registerSubscriber',
                              'registerService'}, methods)

    def test_parameters_of_the_command_line_survive_a_new_master(self):
        def answered(method, arguments):
            """Forget the parameters once they are set, as a new master."""
            if method == 'setParam' and arguments[1] == '/survives/arduino/port':
                rosgraph.Master('/master_test').deleteParam(arguments[1])
            return False

        self.start('survives', answered)
        self.assert_it_works('survives')

    def test_what_was_registered_at_a_master_that_ended_in_between_is_registered_again(self):
        other = self.start_master()

        def answered(method, arguments):
            """Be another master from the second service on."""
            if arguments[1:2] == ('/between/set_logger_level',) and self.server is not other.server:
                self.master.master, self.server = other.uri, other.server
                return True
            return False

        self.start('between', answered)
        until(lambda: self.is_up('between'), 'the bridge is up')
        until(lambda: '/rosout' in state(self.server, '/between')[0] and '/between/get_loggers'
              in state(self.server, '/between')[2], 'the first ones are registered, too', WITHIN)
        self.assertEqual(self.server.getParam('/between/arduino/port'),
                         self.lines['arduino'].near)
        self.assert_it_works('between')

    def test_a_call_that_is_never_answered_does_not_end_announcements(self):
        hung = threading.Event()

        def answered(method, arguments):
            """Never answer the registration of the first announced topic."""
            if method == 'registerPublisher' and arguments[1] == '/hung/force' \
                    and not hung.is_set():
                hung.set()
                time.sleep(1e6)
            return False

        self.start('hung', answered)
        until(lambda: self.is_up('hung'), 'the bridge is up')
        self.announce()
        self.assertTrue(hung.is_set())
        self.assert_it_works('hung')

    def test_ctrl_c_ends_a_start_whose_master_does_not_answer(self):
        asked = threading.Event()

        def answered(method, arguments):
            if method == 'getParam' and arguments[1].rstrip('/') == '/waits':
                asked.set()
                time.sleep(1e6)
            return False

        self.start('waits', answered)
        self.assertTrue(asked.wait(PATIENCE))
        self.assert_ends()


class ReplacedTest(MasterTest):
    """The master of a bridge that runs is replaced by a new one, and then hangs."""

    def test_a_new_master_gets_announced_rows_and_keeps_its_parameters_and_may_hang(self):
        bus, name = self.plug('bus', BusBoard), '/' + PACKAGE
        master = self.start_master()
        self.server = master.server
        self.bridge = self.start_bridge(master=master.uri, parameters={
            'bus/port': self.lines['bus'].near, 'bus/environment_period': 0.2,
            'arduino/port': self.lines['arduino'].near, 'arduino/network_silence': 0.0})
        until(lambda: self.is_up(PACKAGE), 'the bridge is up')
        self.announce()
        before = state(self.server, name)
        self.assertIn(name + '/force', before[0])
        master.end()
        master.start()
        self.server.setParam(name + '/bus/retries', 7)
        until(lambda: state(self.server, name) == before
              and self.server.hasParam(name + '/arduino/announced'), 'all is there again', WITHIN)
        for key, value in (('bus/retries', 7), ('bus/port', self.lines['bus'].near),
                           ('arduino/announced/force/type', 32)):
            self.assertEqual(self.server.getParam(f'{name}/{key}'), value)
        self.bridge.wait_for('is a new ROS master')
        self.assertEqual(self.bridge.output().count('is a new ROS master'), 1)

        master.end()
        with socket.socket() as hung:
            hung.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            hung.bind(('', int(master.uri.rpartition(':')[2])))
            hung.listen(64)
            self.bridge.wait_for('no answer from the ROS master')
            self.lines['bus'].unplug()       # this is logged, also to /rosout
            self.lines['bus'].plug()
            self.bridge.wait_for('opening it again')
            bus.forget()
            until(lambda: bus.others, 'the bus is polled again')
            self.assert_ends()


if __name__ == '__main__':
    rostest.rosrun(PACKAGE, 'master', '__main__')
