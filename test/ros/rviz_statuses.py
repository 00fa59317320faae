#!/usr/bin/python3
"""Shows an rviz configuration and prints what each display says of itself, until all is well.

usage: rviz_statuses.py CONFIG SECONDS. A line for each display and each of its statuses; the exit
status is 0 as soon as no display has a warning or an error, 1 if one has after SECONDS.
"""
import sys
import time

from rviz import bindings as rviz
from python_qt_binding.QtWidgets import QApplication    # after rviz, whose Qt it has to share

SETTLED = 2.0     # s in which nothing may turn bad again


def statuses(display):
    """The statuses of a display by name: Ok, Warn or Error, and more words."""
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
