#!/usr/bin/python3
"""Shows an rviz configuration and prints the statuses of its displays until none has a problem.

usage: rviz_statuses.py CONFIG SECONDS. Prints a line for each status of each display. The exit
status is 0 as soon as no display has a warning or an error, and 1 if one still has after SECONDS.
"""
import sys
import time

from rviz import bindings as rviz
from python_qt_binding.QtWidgets import QApplication    # after rviz, since it must use rviz's Qt

SETTLED = 2.0     # s without a new warning or error


def statuses(display):
    """The statuses of a display by name: Ok, Warn or Error, with a text."""
    found = {}
    for at in range(display.numChildren()):
        child = display.childAt(at)
        if child.getName().startswith('Status'):
            found[child.getName()] = ''
            for number in range(child.numChildren()):
                status = child.childAt(number)
                found[status.getName()] = str(status.getValue())
    return found


def main():
    config, seconds = sys.argv[1], float(sys.argv[2])
    application = QApplication(sys.argv[:1])
    frame = rviz.VisualizationFrame()
    frame.setSplashPath('')
    frame.initialize()
    reader, tree = rviz.YamlConfigReader(), rviz.Config()
    reader.readFile(tree, config)
    assert not reader.error(), reader.errorMessage()
    frame.load(tree)
    frame.show()
    group = frame.getManager().getRootDisplayGroup()
    deadline = time.monotonic() + seconds
    good_since, seen = None, {}
    while time.monotonic() < deadline:
        application.processEvents()
        seen = {group.getDisplayAt(at).getName(): statuses(group.getDisplayAt(at))
                for at in range(group.numDisplays())}
        now = time.monotonic()
        good = all(any(name.startswith('Status') for name in each) and not any(
            word in name for name in each for word in ('Warn', 'Error')) for each in seen.values())
        good_since = (good_since or now) if good else None
        if good_since and now > good_since + SETTLED:
            break
        time.sleep(0.02)
    for display, each in seen.items():
        for name, value in each.items():
            print(f'{display}: {name}: {value}')
    sys.stdout.flush()
    return 0 if good_since else 1


if __name__ == '__main__':
    sys.exit(main())
