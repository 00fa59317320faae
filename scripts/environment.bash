# What the programs of a checkout share: they source this file and call, for example,  set_up run test
# which installs what is missing, builds what has changed, and sources the result.

checkout=$(dirname "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")")
build=$checkout/build
# The ROS that is used, by its setup.bash; without one, that of the system's packages.
prefixes=(/opt/ros/one /opt/ros/noetic)

# All packages: what needs them, and their names. DEBIAN=NAME is ros-noetic-NAME beside
# /opt/ros/noetic, and DEBIAN on a system with ROS packages of its own.
packages() {
    cat <<'END'
run      ros-core-python-dev=ros-core rosbash=ros-core catkin=ros-core python3-tf2-ros=tf2-ros
run      python3-diagnostic-msgs=diagnostic-msgs
run      python3-dynamic-reconfigure=dynamic-reconfigure
# With the package.xml by which rosrun finds dynparam:
run      libdynamic-reconfigure-config-init-mutex-dev=dynamic-reconfigure
run      python3-serial cmake make g++
panel    python3-tornado
test     python3-rostest=rostest python3-rosbag=rosbag python3-pytest python3-pytest-xdist python3-hypothesis
test     catkin-lint python3-flake8 mypy shellcheck libxml2-utils systemd socat
bench    python3-psutil python3-tqdm python3-tabulate
browser  chromium chromium-driver python3-selenium
avr      gcc-avr avr-libc arduino-core-avr avrdude simavr libsimavr-dev libelf-dev pkg-config
ide      arduino-builder arduino-ctags
esp      gcc-xtensa-lx106
view     rviz=rviz python3-rviz=rviz ros-robot-state-publisher=robot-state-publisher xvfb
pictures imagemagick
END
}

say() { printf '==> %s\n' "$*" 2>/dev/null; }    # the reader of a pipe may have ended
say_wrapped() { say "$(fold -sw 74 <<<"$*")"; }

fail() {
    printf '%s: %s\n' "${0##*/}" "$*" >&2
    exit 1
}

wrong_usage() {
    printf '%s: %s\nTry: %s --help\n' "${0##*/}" "$*" "$0" >&2
    exit 2
}

# set_up NEED...: install the missing packages for these needs, build, and source the result.
set_up() {
    local prefix='' each missing
    # Another ROS or Python of the caller's shell would mix with this one.
    unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH PKG_CONFIG_PATH \
        PYTHONPATH PYTHONHOME VIRTUAL_ENV ROS_DISTRO ROS_ETC_DIR ROS_PACKAGE_PATH \
        ROS_PYTHON_VERSION ROS_ROOT ROS_VERSION
    export PYTHONNOUSERSITE=1
    export PATH="/usr/bin:/bin:/usr/sbin:/sbin:$PATH"    # ROS belongs to the system's python3
    for each in "${prefixes[@]}"; do
        if [[ -e $each/setup.bash ]]; then
            prefix=$each
            break
        fi
    done
    missing=$(missing_packages "$prefix" "$@")
    # shellcheck disable=SC2086
    [[ -z $missing ]] || install $missing
    [[ -z $prefix ]] || source_quietly "$prefix/setup.bash"
    build_if_changed
    source_quietly "$build/devel/setup.bash"
    # ROS programs send each other their host's name, so it must resolve.
    [[ -n ${ROS_HOSTNAME:-}${ROS_IP:-} ]] || resolves "$(</proc/sys/kernel/hostname)" ||
        export ROS_HOSTNAME=localhost
    # Logs stay with the build: the home folder may be missing or not writable.
    export ROS_HOME=$build/ros ROS_LOG_DIR=$build/ros/log
    mkdir -p "$ROS_LOG_DIR"
}

# setup.bash reads unset variables.
source_quietly() {
    set +u
    # shellcheck disable=SC1090
    . "$1"
    set -u
}

resolves() {
    timeout 3 getent ahosts "$1" >/dev/null
}

# missing_packages PREFIX NEED...
missing_packages() {
    export LC_ALL=C     # comm and sort agree
    comm -23 <(needed_packages "$@" | sort -u) \
        <(dpkg-query -W -f '${db:Status-Status} ${Package}\n' | sed -n 's/^installed //p' | sort)
    # A minimal system may have no /etc/hosts; this package makes localhost and the host resolve.
    resolves localhost || echo libnss-myhostname
}

# needed_packages PREFIX NEED...
needed_packages() {
    local prefix=$1 need names name ros there
    packages | while read -r need names; do
        [[ " ${*:2} " == *" $need "* ]] || continue
        for name in $names; do
            ros=${name#*=}
            there=${ros/ros-core/roslaunch}     # what was built from source has no metapackage
            if [[ $name != *=* || -z $prefix ]]; then
                echo "${name%=*}"
            elif [[ ! -e $prefix/share/${there//-/_}/package.xml ]]; then    # nor built from source
                echo "ros-${prefix##*/}-$ros"
            fi
        done
    done
}

# install PACKAGE...
install() {
    local as_root=() package known=() lacking=() text
    if ((EUID)); then
        command -v sudo >/dev/null || fail "these packages are missing, and only root may install" \
            "them: $*; run this as root or as a user with sudo."
        as_root=(sudo)
    fi
    as_root+=(env DEBIAN_FRONTEND=noninteractive apt-get -q -o DPkg::Lock::Timeout=300)
    say_wrapped "Installing packages: $*. Some minutes, once ..."
    "${as_root[@]}" update || true      # without a network, apt may have them in its cache
    for package; do
        if apt-cache show "$package" &>/dev/null; then
            known+=("$package")
        else
            lacking+=("$package")
        fi
    done
    if ((${#lacking[@]})); then
        # shellcheck disable=SC1091
        text="$(. /etc/os-release; echo "$PRETTY_NAME") has no package ${lacking[*]}."
        [[ $text != *ros-core* ]] || fail "${text%% has no*} has no packages of ROS 1.
How it gets them, or a container: the table of systems in
$checkout/doc/install.md.
Then run this again."
        [[ $text != *python3-serial* ]] || fail "$text See doc/install.md."
        say_wrapped "$text See doc/install.md. Going on without."
    fi
    ((${#known[@]})) || return 0
    # What apt would do says how much that is. (apt 3 takes -y before --assume-no as a yes.)
    say "$("${as_root[@]}" install --assume-no --no-install-recommends "${known[@]}" 2>/dev/null |
        grep -E '^(Need to get|After this operation)' | tr '\n' ' ')"
    "${as_root[@]}" install -y --no-install-recommends "${known[@]}" ||
        fail "apt-get could not install ${known[*]}; see above."
}

build_if_changed() {
    mkdir -p "$build"
    (
        flock 9
        wanted=$(build_inputs)
        [[ $wanted != "$(cat "$build/.built" 2>/dev/null)" ]] || exit 0
        say "Building in $build ..."
        # cmake refuses a build folder that was moved, and keeps files that are no longer built.
        find "$build" -mindepth 1 -maxdepth 1 ! -name .lock ! -name ros -exec rm -rf {} +
        cmake -S "$checkout" -B "$build" -DPYTHON_EXECUTABLE=/usr/bin/python3 \
            -DCATKIN_ENABLE_TESTING=OFF && make -C "$build" && echo "$wanted" >"$build/.built" ||
            fail "the build failed; see above."
    ) 9>"$build/.lock" || exit
}

# A checksum of what the build depends on: its folder, the ROS, and the files it reads.
build_inputs() {
    (
        cd "$checkout" || exit
        printf '%s\n' "$checkout" "$(readlink -f /usr/bin/python3)" "${CMAKE_PREFIX_PATH:-}"
        sha256sum CMakeLists.txt package.xml setup.py msg/* srv/*
    ) | sha256sum
}
