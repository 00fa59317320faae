"""A master, a robot and a panel that the tests in a browser share."""
import os
import re

import rospy
from boards import (PATIENCE, Bridge, BusBoard, CarBoard, Line, Master, Process, SensorBoard,
                    program)

from serial_communication.boards.arduino import DESCRIPTION

NODE = '/serial_communication'
ROWS = {'cmd_vel': {'type': 41, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Twist',
                    'layout': '<ff', 'fields': ['linear.x', 'angular.z']}}
SETTINGS = {'kp': {'setting': 1, 'layout': '<f', 'minimum': 0, 'maximum': 10, 'unit': '1/s',
                   'description': 'proportional gain'}}
FUNCTIONS = {'halt': {'cmd2': 0x2F, 'srv_type': 'std_srvs/Trigger', 'repeatable': True,
                      'interrupts': True}}
MESSAGES = DESCRIPTION.read('messages', ROWS)
TWIST = MESSAGES[0].message


class Core(Master):
    """A ROS master of its own, and the node that collects the log; it sets ROS_MASTER_URI."""

    def start(self):
        os.environ.update(ROS_MASTER_URI=self.uri, ROS_HOSTNAME='localhost')
        self._rosout = Process('rosrun', 'rosout', 'rosout')
        return super().start()

    def end(self):
        self._rosout.kill()
        super().end()


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
            'bus/environment_period': 0.2, 'bus/functions': FUNCTIONS,
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
