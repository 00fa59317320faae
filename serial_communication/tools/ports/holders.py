"""The programs that have a device open, as far as this user may see them."""
import os
from contextlib import suppress
from typing import List, NamedTuple, Set

from ...transport.port import open_in


class Holder(NamedTuple):
    """A program that has the device open."""

    pid: int
    name: str      # of a script, not of its interpreter

    def __str__(self) -> str:
        return f'{self.name} (pid {self.pid})'


def holders_of(path: str) -> List[Holder]:
    """The programs that have a device open, or hold its lock, by their process ids."""
    try:
        port = os.stat(path)
    except OSError:
        return []
    return [holder(pid) for pid in sorted(_by_lock(port) | open_in(path))]


def _by_lock(port: os.stat_result) -> Set[int]:
    """Those that hold its lock; seen for the processes of all users."""
    inode = f'{os.major(port.st_dev):02x}:{os.minor(port.st_dev):02x}:{port.st_ino}'
    try:
        with open('/proc/locks') as locks:
            return {int(words[4]) for words in map(str.split, locks)
                    if words[1] == 'FLOCK' and words[5] == inode and int(words[4]) > 0}
    except (OSError, IndexError, ValueError):
        return set()


def holder(pid: int) -> Holder:
    """This process with the name of its program; '?' if it has just ended."""
    words: List[str] = []
    with suppress(OSError), open(f'/proc/{pid}/cmdline', encoding='utf-8',
                                 errors='replace') as file:
        words = [word for word in file.read().split('\0') if word]
    names = [os.path.basename(word) for word in words] or ['?']
    is_script = names[0].startswith('python') and len(words) > 1 and words[1][0] != '-'
    return Holder(pid, names[is_script])
