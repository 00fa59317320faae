# Set-up that the programs of a checkout share: installs, builds and sources the package. They
# source this file and call, for example,  set_up run  or  set_up run test avr.
#
# If nothing is missing and nothing has changed, this takes a fraction of a second and uses no
# network, no package manager and no cmake.

checkout=$(dirname "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")")
build=$checkout/build
noetic=/opt/ros/noetic

# All packages: what needs them, and their names on both systems.
packages() {
    cat <<'END'
# need | Debian 12                                   | Ubuntu 20.04 with /opt/ros/noetic
run    | ros-core-python-dev rosbash catkin          | ros-noetic-ros-core
run    | python3-tf2-ros python3-diagnostic-updater  | ros-noetic-tf2-ros ros-noetic-diagnostic-updater
run    | python3-dynamic-reconfigure                 | ros-noetic-dynamic-reconfigure
# With the package.xml by which rosrun finds dynparam:
run    | libdynamic-reconfigure-config-init-mutex-dev |
run    | python3-serial cmake make g++               | python3-serial cmake make g++
panel  | python3-tornado python3-qrcode              | python3-tornado python3-qrcode
test   | python3-rostest python3-rosbag              | ros-noetic-rostest ros-noetic-rosbag
test   | python3-pytest python3-hypothesis           | python3-pytest python3-hypothesis
test   | catkin-lint python3-flake8                  | catkin-lint python3-flake8
test   | shellcheck libxml2-utils systemd socat      | shellcheck libxml2-utils systemd socat
# Ubuntu's mypy is too old.
test   | mypy                                        |
bench  | python3-psutil python3-tqdm                 | python3-psutil python3-tqdm
bench  | python3-tabulate                            | python3-tabulate
# Ubuntu has chromium only as a snap, which the driver cannot start.
browser | chromium chromium-driver python3-selenium  |
avr    | gcc-avr avr-libc arduino-core-avr           | gcc-avr avr-libc arduino-core-avr
avr    | simavr libsimavr-dev libelf-dev pkg-config  | simavr libsimavr-dev libelf-dev pkg-config
avr    | avrdude                                     | avrdude
ide    | arduino-builder arduino-ctags               | arduino-builder arduino-ctags
esp    | gcc-xtensa-lx106                            | gcc-xtensa-lx106
# Ubuntu's QEMU is too old: it has no lx106.
esp    | qemu-system-misc                            |
view   | rviz python3-rviz ros-robot-state-publisher | ros-noetic-rviz ros-noetic-robot-state-publisher
view   | xvfb                                        | xvfb
pictures | imagemagick                               | imagemagick
END
}

say() { printf '==> %s\n' "$*" 2>/dev/null; }    # the reader of a pipe may have ended

fail() {
    printf '%s: %s\n' "${0##*/}" "$*" >&2
    exit 1
}

# fail_if_disk_full [LOG]: fail if a disk that is written to is full, or if LOG says so.
fail_if_disk_full() {
    local folder free full=''
    [[ ! -e ${1:-} ]] || ! grep -qE 'No space left|quota exceeded' "$1" || full='a disk'
    for folder in "${TMPDIR:-/tmp}" "$checkout" "$build" "${ROS_LOG_DIR:-$build}"; do
        free=$(df --output=avail -k "$folder" 2>/dev/null | tail -n 1) || continue
        ((free > 1000)) || full="the disk of $folder"
    done
    [[ -z $full ]] || fail "no space left on $full: make room (df -h, df -i), then try again."
}

# set_up NEED...: install the missing packages for these needs, build, and source the result.
set_up() {
    forget_other_ros
    if [[ ! -d $noetic ]]; then
        is_debian_12 || fail "this system is neither Debian 12 nor one with $noetic." \
            "A container of Debian 12 does, here with the demo:" \
            "$(printf 'docker run -it --network host -v %q:/bridge debian:12 /bridge/scripts/demo' \
                "$checkout")"
    fi
    local missing
    missing=$(missing_packages "$@")
    # shellcheck disable=SC2086
    [[ -z $missing ]] || install $missing
    [[ ! -d $noetic ]] || source_quietly "$noetic/setup.bash"
    build_if_changed
    source_quietly "$build/devel/setup.bash"
    set_host_name
    # Logs stay with the build: the home folder may be missing or not writable.
    export ROS_HOME=$build/ros ROS_LOG_DIR=$build/ros/log
    mkdir -p "$ROS_LOG_DIR"
    delete_old_logs
}

# A folder may be older than the files in it, and another program may delete the same files.
delete_old_logs() {
    find "$ROS_LOG_DIR" -ignore_readdir_race -mindepth 1 -mtime +7 \( ! -type d -o -empty \) -delete ||
        true
}

# Remove the settings of another ROS or Python in the caller's shell, which would mix with this one.
# The caller's ROS_MASTER_URI, ROS_IP and ROS_HOSTNAME are kept.
forget_other_ros() {
    unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH PKG_CONFIG_PATH \
        PYTHONPATH PYTHONHOME VIRTUAL_ENV ROS_DISTRO ROS_ETC_DIR ROS_PACKAGE_PATH \
        ROS_PYTHON_VERSION ROS_ROOT ROS_VERSION
    export PYTHONNOUSERSITE=1
    export PATH="/usr/bin:/bin:/usr/sbin:/sbin:$PATH"    # ROS belongs to the system's python3
}

is_debian_12() (
    [[ -r /etc/os-release ]] || return 1
    # shellcheck disable=SC1091
    . /etc/os-release
    [[ ${ID:-} == debian && ${VERSION_ID:-} == 12 ]]
)

# -- packages ------------------------------------------------------------------------------

# missing_packages NEED...
missing_packages() {
    local needed installed package
    needed=$(needed_packages "$@")
    # shellcheck disable=SC2086
    installed=$(dpkg-query -W -f '${db:Status-Status} ${Package}\n' $needed 2>/dev/null || true)
    for package in $needed; do
        grep -qx "installed $package" <<<"$installed" || built_from_source "$package" ||
            printf '%s ' "$package"
    done
    # A minimal system may have no /etc/hosts; this package makes localhost and the host resolve.
    resolves localhost || printf 'libnss-myhostname '
}

needed_packages() {
    local need debian ubuntu
    packages | while IFS='|' read -r need debian ubuntu; do
        if [[ " $* " == *" ${need// /} "* ]]; then
            if [[ -d $noetic ]]; then echo "$ubuntu"; else echo "$debian"; fi
        fi
    done
}

# A ROS built from source has no package of that name.
built_from_source() {
    local name=${1#ros-noetic-}
    [[ $name != "$1" && -e $noetic/share/${name//-/_}/package.xml ]]
}

# install PACKAGE...
install() {
    local as_root=() log apt traps stopped='' status
    if ((EUID)); then
        may_use_sudo || fail "these packages are missing, and only root may install them: $*;" \
            "run this as root or as a user with sudo, or ask an administrator to install them."
        as_root=(sudo -n)
    fi
    log=$(mktemp)
    say "Installing $# missing packages and their dependencies: two to four minutes, once ..."
    # Ctrl-C must not end apt-get half-way, so it gets a process group of its own.
    traps=$(trap -p INT USR1)
    trap 'finish_first' INT USR1
    set -m
    {
        "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive bash -c "$apt_install" apt-get "$@" \
            </dev/null 2>&1 | tee "$log" | show_last_line
    } &
    apt=$!
    set +m
    while status=0; wait "$apt" || status=$?; kill -0 "$apt" 2>/dev/null; do :; done
    trap - INT USR1
    eval "$traps"
    [[ -z $stopped ]] || { rm -f "$log"; kill -INT $$; }
    ((status == 0)) || explain_failed_install "$log" "$*"
    rm -f "$log"
}

# What root runs. The package lists are fetched only if they are missing or too old.
# shellcheck disable=SC2016  # its own variables
apt_install='
get() { apt-get -q -y -o DPkg::Lock::Timeout=300 "$@"; }
add() { get install --no-install-recommends "$@"; }
add "$@" || { get update; add "$@"; }'

# shellcheck disable=SC2317  # called from a trap
finish_first() {
    clear_line
    [[ -n $stopped ]] || say "Ctrl-C: apt-get finishes first, then ${0##*/} ends ..."
    stopped=yes
}

# On a terminal, show the latest line of the input. sudo's pty ends lines with CR LF.
show_last_line() {
    local line
    trap '' TTOU    # after `stty tostop`
    while read -r line; do
        [[ ! -t 1 ]] || printf '    %.74s\e[K\r' "${line%$'\r'}"
    done
    clear_line
}

clear_line() { [[ ! -t 1 ]] || printf '\r\e[K'; }

# sudo may ask for a password only on a terminal.
may_use_sudo() {
    command -v sudo >/dev/null || return 1
    sudo -n true 2>/dev/null || {
        [[ -t 0 ]] && say "Packages are missing. To install them, sudo asks for your password:" &&
            sudo -v && sudo -n true
    }
}

# explain_failed_install LOG PACKAGES
explain_failed_install() {
    fail_if_disk_full "$1"
    grep -E '^(E|Err):?' "$1" | tail -n 5 >&2 || true
    if grep -qE 'Could not resolve|Temporary failure|Could not connect|Unable to connect' "$1"; then
        fail "the packages cannot be fetched: connect this machine to the network and try" \
            "again (the output of apt-get: $1)."
    fi
    fail "apt-get could not install $2; see above, and $1 for its whole output."
}

# -- build ---------------------------------------------------------------------------------

build_if_changed() {
    mkdir -p "$build" 2>/dev/null || fail_if_disk_full
    [[ -w $build ]] ||
        fail "$build cannot be written to; use your own checkout, or make $(id -un) its owner."
    (
        flock 9 ||
            fail "$build/.lock cannot be locked; see the message of flock above."
        local wanted log=$build/build.log
        wanted=$(build_inputs)
        if [[ -e $build/devel/setup.bash && $wanted == "$(cat "$build/.built" 2>/dev/null)" ]]; then
            exit 0
        fi
        say "Building in $build ..."
        # cmake refuses a build folder that was moved, and keeps files that are no longer built.
        find "$build" -mindepth 1 -maxdepth 1 ! -name .lock ! -name ros -exec rm -rf {} + ||
            fail "$build holds files of another user; remove it, then try again."
        if ! { cmake -S "$checkout" -B "$build" -DPYTHON_EXECUTABLE=/usr/bin/python3 \
            -DCATKIN_ENABLE_TESTING=OFF && make -C "$build" && echo "$wanted" >"$build/.built"
        } 2>&1 | tee "$log" 2>/dev/null | show_last_line; then
            fail_if_disk_full "$log"
            tail -n 20 "$log" >&2
            fail "the build failed; see above, and $log for its whole output."
        fi
    ) 9>"$build/.lock" || exit
}

# A checksum of what the build depends on: its folder, the ROS, and the files it reads.
build_inputs() {
    (
        cd "$checkout" || exit
        printf '%s\n' "$checkout" "$(readlink -f /usr/bin/python3)" "${ROS_ROOT:-}"
        sha256sum CMakeLists.txt package.xml setup.py msg/* srv/*
    ) | sha256sum
}

# setup.bash reads unset variables.
source_quietly() {
    set +u
    # shellcheck disable=SC1090
    . "$1"
    set -u
}

# ROS programs send each other their host's name, so it must resolve.
set_host_name() {
    resolves localhost ||
        fail "the name localhost does not resolve: add the line '127.0.0.1 localhost' to" \
            "/etc/hosts."
    if [[ -z ${ROS_HOSTNAME:-}${ROS_IP:-} ]] &&
        ! resolves "$(</proc/sys/kernel/hostname)"; then
        export ROS_HOSTNAME=localhost
    fi
}

resolves() {
    timeout 3 getent ahosts "$1" >/dev/null
}
