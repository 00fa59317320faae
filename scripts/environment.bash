# Set-up that the programs of a checkout share: installs, builds and sources the package. They
# source this file and call, for example,  set_up run  or  set_up run test avr.
#
# If nothing is missing and nothing has changed, this takes a fraction of a second and uses no
# network, no package manager and no cmake.

checkout=$(dirname "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")")
build=$checkout/build
# The ROS that is used, by its setup.bash; without one, that of the system's packages.
prefixes=(/opt/ros/one /opt/ros/noetic)

# All packages: what needs them, and their names. DEBIAN=NAME is ros-noetic-NAME beside
# /opt/ros/noetic, and DEBIAN on a system with ROS packages of its own.
packages() {
    cat <<'END'
run      ros-core-python-dev=ros-core rosbash=ros-core catkin=ros-core python3-tf2-ros=tf2-ros
run      python3-diagnostic-updater=diagnostic-updater
run      python3-dynamic-reconfigure=dynamic-reconfigure
# With the package.xml by which rosrun finds dynparam:
run      libdynamic-reconfigure-config-init-mutex-dev=dynamic-reconfigure
run      python3-serial cmake make g++
panel    python3-tornado python3-qrcode
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

fail() {
    printf '%s: %s\n' "${0##*/}" "$*" >&2
    exit 1
}

# set_up NEED...: install the missing packages for these needs, build, and source the result.
set_up() {
    local prefix missing
    forget_other_ros
    prefix=$(ros_prefix)
    missing=$(missing_packages "$@")
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

# Remove the settings of another ROS or Python in the caller's shell, which would mix with this one.
# The caller's ROS_MASTER_URI, ROS_IP and ROS_HOSTNAME are kept.
forget_other_ros() {
    unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH PKG_CONFIG_PATH \
        PYTHONPATH PYTHONHOME VIRTUAL_ENV ROS_DISTRO ROS_ETC_DIR ROS_PACKAGE_PATH \
        ROS_PYTHON_VERSION ROS_ROOT ROS_VERSION
    export PYTHONNOUSERSITE=1
    export PATH="/usr/bin:/bin:/usr/sbin:/sbin:$PATH"    # ROS belongs to the system's python3
}

ros_prefix() {
    local prefix
    for prefix in "${prefixes[@]}"; do
        [[ ! -e $prefix/setup.bash ]] || { echo "$prefix" && return; }
    done
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

# needed_packages NEED...
needed_packages() {
    local prefix need names name
    prefix=$(ros_prefix)
    packages | while read -r need names; do
        [[ " $* " == *" $need "* ]] || continue
        for name in $names; do
            if [[ $name == *=* && -n $prefix ]]; then
                echo "ros-${prefix##*/}-${name#*=}"
            else
                echo "${name%=*}"
            fi
        done
    done | sort -u
}

# A ROS built from source has no package of that name.
built_from_source() {
    local prefix name=${1#ros-*-}
    prefix=$(ros_prefix)
    [[ -n $prefix && $name != "$1" && -e $prefix/share/${name//-/_}/package.xml ]]
}

# install PACKAGE...
install() {
    local as_root=() package known=() lacking=()
    if ((EUID)); then
        command -v sudo >/dev/null || fail "these packages are missing, and only root may install" \
            "them: $*; run this as root or as a user with sudo."
        as_root=(sudo)
    fi
    as_root+=(env DEBIAN_FRONTEND=noninteractive apt-get -q -y -o DPkg::Lock::Timeout=300)
    say "Installing packages: $*. Two to four minutes, once ..."
    "${as_root[@]}" update || true      # without a network, apt may have them in its cache
    for package; do
        if apt-cache show "$package" &>/dev/null; then
            known+=("$package")
        else
            lacking+=("$package")
        fi
    done
    if ((${#lacking[@]})); then without "${lacking[@]}"; fi
    ((${#known[@]} == 0)) || "${as_root[@]}" install --no-install-recommends "${known[@]}" ||
        fail "apt-get could not install ${known[*]}; see above."
}

# without PACKAGE...: go on without packages that the system does not have, if the bridge can.
without() {
    local package text
    # shellcheck disable=SC1091
    text="$(. /etc/os-release; echo "$PRETTY_NAME") has no package $*; see doc/install.md"
    for package in $(needed_packages run); do
        [[ " $* " != *" $package "* ]] || fail "$text"
    done
    say "$text. Going on without."
}

# -- build ---------------------------------------------------------------------------------

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
