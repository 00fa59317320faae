"""All tests as an ordinary user of a new Debian, with nothing but what scripts/test installs."""
import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
_MAKE = '''
debootstrap --variant=minbase --include=sudo,git,ca-certificates {suite} {folder}
chroot {folder} useradd --create-home --shell /bin/bash user
echo 'user ALL=(ALL) NOPASSWD:ALL' >{folder}/etc/sudoers.d/user
cp /etc/hosts /etc/hostname /etc/resolv.conf {folder}/etc
git clone --quiet {root} {folder}/home/user/bridge
chroot {folder} chown -R user /home/user
mount -t proc proc {folder}/proc
mount --rbind /dev {folder}/dev
mount -t devpts -o newinstance,gid=5,mode=620,ptmxmode=666 devpts {folder}/dev/pts
exec chroot {folder} su - user -c bridge/scripts/test
'''


def outside():
    """A process with the network of the computer, from which scripts/test keeps tests apart."""
    pid, own = os.getpid(), os.stat('/proc/self/ns/net').st_ino
    while pid and os.stat(f'/proc/{pid}/ns/net').st_ino == own:
        pid = int(Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[1])
    return pid or os.getpid()


@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which('debootstrap'),
                    reason='needs root and debootstrap')
@pytest.mark.parametrize('suite', ['bookworm', 'trixie'])
def test_all_tests_pass_in_a_new(suite, tmp_path):
    done = subprocess.run(      # its mounts end with it
        ['nsenter', f'--target={outside()}', '--net', 'unshare', '--mount', '--pid', '--fork',
         '--kill-child', 'bash', '-ec',
         _MAKE.format(suite=suite, folder=tmp_path / 'root', root=ROOT)],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    shutil.rmtree(str(tmp_path / 'root'), ignore_errors=True)
    assert ' passed, 0 failed' in done.stdout.splitlines()[-1], done.stdout[-20000:]
