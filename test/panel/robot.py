"""A master, a robot, and a panel that the tests in a browser share."""
import os
import re

import rosgraph
import rospy
from boards import (PATIENCE, Bridge, BusBoard, CarBoard, Line, Process, SensorBoard, free_master,
                    program, until)

from serial_communication.boards.arduino import DESCRIPTION

NODE = '/serial_communication'
ROWS = {'cmd_vel': {'type': 41, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Twist',
                    'layout': '<ff', 'fields': ['linear.x', 'angular.z']}}
SETTINGS = {'kp': {'setting': 1, 'layout': '<f', 'minimum': 0, 'maximum': 10, 'unit': '1/s',
                   'description': 'proportional gain'}}
MESSAGES = DESCRIPTION.read('messages', ROWS)
TWIST = MESSAGES[0].message


class Core:
    """A roscore of its own; it sets ROS_MASTER_URI."""

    def __init__(self):
        os.environ['ROS_MASTER_URI'] = free_master()
        os.environ['ROS_HOSTNAME'] = 'localhost'
        self.start()

    def start(self):
        """Start it, and wait until it is complete."""
        self._process = Process('roscore', '-p', os.environ['ROS_MASTER_URI'].rsplit(':', 1)[1])

        def complete():
            return rosgraph.is_master_online() and any(
                name == '/rosout' for name, _nodes in
                rosgraph.Master('/panel_test').getSystemState()[1])
        until(complete, 'roscore is complete', every=0.1)

    def stop(self):
        """Stop it, and wait until it has ended."""
        self._process.end()


class Robot:
    """Lines, boards that send as real ones do, and a bridge."""

    def __init__(self, folder):
        self.lines = {name: Line(os.path.join(folder, name)).plug()
                      for name in ('bus', 'arduino', 'mcu')}
        self.bus = BusBoard(self.lines['bus'].far)
        self.car = CarBoard(self.lines['arduino'].far, measures=True, custom=MESSAGES,
                            settings=DESCRIPTION.read('settings', SETTINGS))
        self.sensors = SensorBoard(self.lines['mcu'].far, measures=True)
        self.start_bridge()

    def start_bridge(self):
        """Start the bridge, and wait for its services."""
        self.bridge = Bridge(parameters={
            **{f'{name}/port': line.near for name, line in self.lines.items()},
            'bus/environment_period': 0.2,
            'arduino/settings': SETTINGS, 'arduino/messages': ROWS})
        rospy.wait_for_service(NODE + '/calibrate_imu', PATIENCE)

    def end(self):
        """End the bridge, the boards and the lines."""
        self.bridge.end()
        for board in (self.bus, self.car, self.sensors):
            board.close()
        for line in self.lines.values():
            line.unplug()

    @property
    def twists(self):
        """The commands cmd_vel that the car's board has received: (linear.x, angular.z)."""
        return [tuple(message) for message in self.car.messages(TWIST)]


class Panel(Process):
    """A panel in a process of its own. As a context it ends with its block, and has to end well."""

    def __init__(self, *arguments, name='panel'):
        super().__init__(program('panel'), '--port', '0', *arguments, '__name:=' + name)
        self.url = re.search(r'http://\S+', self.wait_for('http://')).group()

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        status = self.end()
        assert kind or status == 0 and 'Traceback' not in self.output(), self.output()
