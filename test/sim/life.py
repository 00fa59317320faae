"""What programs and people do with a robot, and the faults that happen to it; all by the seed."""
from typing import Any, Callable, List, Tuple

from scenario import OTHER_FUNCTIONS, Called, Command, Event, Story, Told
from world import World

# Of another board behind the same port: one of its types has another meaning.
OTHER_ROWS = {'push': {'type': 32, 'ros_type': 'std_msgs/Int16', 'layout': '<h',
                       'fields': ['data']}}


def live(seed: int, seconds: float = 25.0, hertz: float = 10.0) -> List[Story]:
    """The stories of one robot, all told: one to three links in one world."""
    world = World(seed)
    random = world.random
    kinds = [kind for kind in ('arduino', 'bus', 'mcu') if random.random() < 0.55] or ['arduino']
    calm = random.random() < 0.1
    stories = [Story(world, kind, hertz, calm) for kind in kinds]
    for story in stories:
        if story.kind != 'mcu':
            {'arduino': _drive, 'bus': _call}[story.kind](story)
        _tune(story)
        story.every(0.9, 1.1, story.look)
        if random.random() < 0.5:
            _hold(story)
        if random.random() < 0.5:
            story.every(4.0, 15.0, lambda story=story: _borrow(story))
        if not calm:
            for fault in random.sample(FAULTS, random.randint(0, 4)):
                story.every(2.0, 8.0, lambda story=story, fault=fault: fault(story))
    if not calm and random.random() < 0.5:
        stories[0].every(3.0, 9.0, lambda: _suspend(stories))
    world.run(seconds)
    for story in stories:
        story.end()
    world.run(1.0)
    return stories


def _command(story: Story, name: str, *values: Any) -> None:
    now = story.world.clock()
    refused = story.robot.command(name, *values)
    story.commands.append(Command(
        now, name, values if len(values) > 1 else values[0] if values else None, refused))


def _drive(story: Story) -> None:
    random = story.random

    def speed(number: int) -> None:
        value = number % 1000 + 1 if random.random() < 0.95 else 1000 + number
        _command(story, 'speed', value * (1 if number % 2 else -1))

    def burst() -> None:
        """Drive for a while; end it with a stop, or by silence."""
        until = story.world.time + random.uniform(0.1, 2.5)
        period = random.choice((0.02, 0.05, 0.1, 0.4))
        same = story.number() if random.random() < 0.3 else 0

        def again() -> None:
            if story.ended is not None:
                return
            if story.world.time < until:
                speed(same or story.number())
                story.world.after(period, again)
            elif random.random() < 0.4:
                _command(story, 'speed', 0)
        again()
    story.every(0.5, 4.0, burst)
    story.every(0.1, 1.0, lambda: _command(story, 'steering', 1000 + story.number()))
    story.every(0.5, 5.0, lambda: _command(story, 'led', random.choice(
        ('left {}', 'right {}', 'é {}', '{:31}')).format(story.number())))

    def row(name: str, *values: float) -> None:
        if name in story.robot.commands:        # else nobody can publish to it
            _command(story, name, *values)

    def drive() -> None:
        """Move by a row for a while; end it with its zero, or by silence."""
        until = story.world.time + random.uniform(0.1, 2.0)
        period = random.choice((0.05, 0.2, 0.4))

        def again() -> None:
            number = story.number()
            raw = number % 2000 + 1 if random.random() < 0.95 else 2000 + number
            if story.ended is None and story.world.time < until:
                raw = raw if random.random() < 0.98 else float('nan')
                row('drive', raw / 1000 * (1 if number % 2 else -1), number % 7 / 1000)
                story.world.after(period, again)
            elif story.ended is None and random.random() < 0.4:
                row('drive', 0.0, 0.0)
        again()

    story.every(0.3, 2.0, lambda: row('gripper', story.number()))
    story.every(1.0, 5.0, drive)
    if random.random() < 0.5:
        story.world.after(random.uniform(1.0, 5.0), lambda: story.every(
            1.0, 15.0, lambda: _command(story, 'calibrate')))


def _call(story: Story) -> None:
    random = story.random

    def call() -> None:
        number, functions = story.number(), story.robot.functions
        name = random.choice(('lift', 'gimbal', 'press', 'press', 'level', 'environment', 'echo',
                              'sync', 'raw', 'halt'))
        data = number.to_bytes(2, 'little')
        cmd1, cmd2 = 0x55, 0
        if name in functions:
            cmd2, data = functions[name].number, b'' if name == 'halt' else data
        elif name in ('press', 'level', 'halt'):
            return      # not announced now
        elif name == 'raw':
            # As long as a reading, or not.
            cmd2, data = 0xF0, data + random.choice((b'', b'\0\0\x88\x13'))
        elif name == 'echo':
            cmd1 = 0x01
        elif name == 'sync':
            cmd1, data = 0x00, b''
        elif name == 'environment':
            cmd2, data = 0x22, b''
        else:
            cmd2 = 0x20 if name == 'lift' else 0x21
            data = bytes((number % 2, number % 200 + 1))
        called = Called(story.world.clock(), name, (cmd1, cmd2, data))
        story.calls.append(called)

        def told(*what: Any) -> None:
            if called.ended is None:
                called.told, called.ended = Told(*what), story.world.clock()
        called.repeatable, called.longest = story.robot.call(cmd1, cmd2, data, name, told)
    story.every(0.05, random.choice((0.5, 3.0, 12.0)), call)


def _tune(story: Story) -> None:
    if story.kind == 'bus':
        return

    def want() -> None:
        name, value = story.random.choice((('kp', story.number() % 40 / 4),
                                           ('limit', story.number() % 500)))
        now = story.world.clock()
        if story.robot.want(name, value):       # else nobody can set it
            story.wants.append((now, name, value))
    story.every(1.0, 8.0, want)


def _hold(story: Story) -> None:
    """Call ~stop, and release it later."""
    def stop() -> None:
        begin = story.world.clock()
        story.stopped_at.append(begin)
        answer = story.robot.stop(True)

        def release() -> None:
            story.events.append(Event(begin, story.world.clock(), 'stop', answer))
            story.robot.stop(False)
        story.world.after(story.random.uniform(0.3, 3.0), release)
    story.every(5.0, 20.0, stop)


def _borrow(story: Story) -> None:
    if story.random.random() < 0.5:
        now = story.world.clock()
        story.tasks.append((now, now, 'reset', story.robot.lend_or_reset(0.0)))
        return
    seconds = story.random.uniform(0.2, 3.0)
    now = story.world.clock()
    story.tasks.append((now, now + seconds, 'lend', story.robot.lend_or_reset(seconds)))


def _suspend(stories: List[Story]) -> None:
    """The whole bridge does not run."""
    seconds = _some(stories[0])
    for story in stories:
        story.happen('suspended', seconds)
    stories[0].world.freeze(seconds)


def _some(story: Story) -> float:
    return story.random.choice((0.05, 0.2, 0.4, 0.7, 1.5, 3.0)) * story.random.uniform(0.8, 1.2)


def _starve(story: Story) -> None:
    """One loop does not run."""
    seconds, index = _some(story), story.random.randrange(len(story.robot.loops))
    story.happen('starved', seconds, index)
    story.robot.loops[index].starve(seconds)


def _freeze_in_write(story: Story) -> None:
    """The bridge is suspended inside its next write, before or after the kernel has taken it."""
    seconds = _some(story)

    def freeze() -> None:
        story.happen('suspended', seconds)
        story.world.freeze(seconds)
    story.device.in_write = freeze, story.random.random() < 0.5, _concerned(story)


def _concerned(story: Story) -> Callable[[bytes], bool]:
    """Any bytes, or only a request that moves something."""
    if story.kind != 'bus' or story.random.random() < 0.3:
        return lambda data: True
    return lambda data: data[2:3] == b'\x55' and data[3:4] in b'\x20\x21\x30\xF0'


def _unplug(story: Story) -> None:
    if not story.device.is_there:
        return
    seconds = _some(story)
    story.happen('unplugged', seconds)
    story.device.unplug()
    other = story.random.random() < 0.4

    def plug() -> None:
        if other:
            rows = OTHER_FUNCTIONS if story.kind == 'bus' else OTHER_ROWS
            story.far.put(story.new_board(rows if story.random.random() < 0.5 else None))
        story.device.plug()
    story.world.after(seconds, plug)


def _reset(story: Story) -> None:
    seconds = story.random.uniform(0.1, 1.0)
    story.happen('reset', seconds)
    story.far.reset(seconds)


def _silence(story: Story) -> None:
    seconds = _some(story)
    story.happen('silence', seconds)
    story.far.silence(seconds)


def _block(story: Story) -> None:
    """The far end takes nothing; that of a network often says nothing either."""
    seconds = _some(story)
    story.happen('blocked', seconds)
    story.device.block(seconds)
    if story.device.kind == 'network' and story.random.random() < 0.7:
        story.happen('silence', seconds)
        story.far.silence(seconds)


def _block_in_write(story: Story) -> None:
    """The far end takes nothing from the next write on."""
    story.device.in_write = (lambda: _block(story)), story.kind != 'bus', _concerned(story)


def _alter(story: Story) -> None:
    if story.device.kind != 'network':
        story.happen('altered', 0.0)
        story.device.is_altered = True


def _cut(story: Story) -> None:
    if story.device.kind == 'network':
        story.happen('cut', 0.0)
        story.device.reset_connection()


def _pull_in_write(story: Story) -> None:
    """It is unplugged once the kernel has taken its next write."""
    story.device.in_write = (lambda: _unplug(story)), False, _concerned(story)


def _dribble(story: Story) -> None:
    """A frame seems to begin, and goes on byte by byte."""
    start = {'bus': b'\xA5\xF0\x02', 'mcu': b'\x02\xF0\x70', 'arduino': b'\xF0'}[story.kind]
    count = story.random.randint(5, 40)
    for index, byte in enumerate(start + bytes(count)):
        story.world.after(0.03 * index, lambda byte=byte: story.device.from_board(
            bytes((byte or 0x41,))))
    story.happen('noise', 0.03 * (count + 3), b'')


def _noise(story: Story) -> None:
    data = bytes(story.random.randrange(256) for _ in range(story.random.choice((1, 5, 40))))
    story.happen('noise', 0.0, data)
    story.device.from_board(data)


FAULTS: Tuple[Callable[[Story], None], ...] = (
    _starve, _starve, _freeze_in_write, _unplug, _reset, _silence, _block, _block_in_write,
    _silence, _alter, _cut, _noise, _dribble, _pull_in_write)
