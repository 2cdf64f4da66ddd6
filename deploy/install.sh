#!/usr/bin/env bash
# Installs zbridge on a Debian host (12 or newer): a virtual environment in /opt/zbridge, the configuration in /etc/zbridge, a user, systemd units.
# Run it again to upgrade or to repair: it leaves alone what is correct, and never overwrites a file in /etc/zbridge.
set -euo pipefail

usage() {
    cat <<'END'
usage: install.sh [--wheels PATH] [--extras LIST] [--router] [--recorder] [--console] [--serial] [--no-start]
       install.sh --uninstall [--purge]

--wheels PATH   a folder with the wheels of zbridge and its dependencies, or the zbridge wheel in such a folder; downloads nothing.
                Build it on a machine with a network: pip wheel -w wheels '.[certs,serial]', with foxglove for --recorder,
                console for --console
                Without --wheels: installs the checkout that contains this script, and downloads the dependencies.
--extras LIST   extras of zbridge, separated by commas; default "certs,serial", foxglove with a recorder, console with a
                console; "" for none
--router        also run the router of the bus      (/etc/zbridge/router.toml, /etc/zbridge/router)
--recorder      also record all robots              (/etc/zbridge/recorder.env, /etc/zbridge/recorder)
--console       also serve the console to browsers  (/etc/zbridge/console.env, /etc/zbridge/console)
--serial        let gateways open serial lines
--no-start      enable the units, but start none
--uninstall     stop and remove the units and /opt/zbridge; keep /etc/zbridge, /var/lib/zbridge and the recordings
--purge         with --uninstall: remove those and the user as well
END
}

prefix=/opt/zbridge
etc=/etc/zbridge
units=/etc/systemd/system
all_units=(zbridge.service zbridge@.service zbridge-router.service zbridge-recorder.service zbridge-console.service)

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
wheels='' extras=default router='' recorder='' console='' serial='' start=yes uninstall='' purge=''

say() { printf '%s\n' "zbridge: $*"; }
die() { printf '%s\n' "zbridge: $*" >&2; exit "${2:-1}"; }
wrong() { printf '%s\n' "zbridge: $*" >&2; usage >&2; exit 2; }

while [ $# -gt 0 ]; do
    case $1 in
        --wheels) [ $# -gt 1 ] || wrong "--wheels: expected a path"; wheels=$2; shift ;;
        --extras) [ $# -gt 1 ] || wrong "--extras: expected a list"; extras=$2; shift ;;
        --router) router=yes ;;
        --recorder) recorder=yes ;;
        --console) console=yes ;;
        --serial) serial=yes ;;
        --no-start) start='' ;;
        --uninstall) uninstall=yes ;;
        --purge) purge=yes ;;
        -h | --help) usage; exit 0 ;;
        *) wrong "$1: unknown option" ;;
    esac
    shift
done
[ -z "$purge" ] || [ -n "$uninstall" ] || wrong "--purge: requires --uninstall"
if [ "$extras" = default ]; then
    extras=certs,serial
    if [ -n "$recorder" ] || [ -L "$units/multi-user.target.wants/zbridge-recorder.service" ]; then extras+=,foxglove; fi
    if [ -n "$console" ] || [ -L "$units/multi-user.target.wants/zbridge-console.service" ]; then extras+=,console; fi
fi
[ "$(id -u)" -eq 0 ] || die "must be run as root"

# Without a running systemd (a chroot, an image build) the units are enabled for the next boot.
booted() { [ -d /run/systemd/system ]; }
has_systemctl() { command -v systemctl >/dev/null; }

put() { # SOURCE TARGET [MODE]: copies a file that differs; succeeds if it changed the target
    if cmp -s "$1" "$2"; then return 1; fi
    install -D -m "${3:-0644}" "$1" "$2"
    say "wrote $2"
}

keep() { # SOURCE TARGET MODE: copies a file unless the target exists
    [ -e "$2" ] || put "$1" "$2" "$3"
}

instances() { # prints the enabled units of single robots
    local link
    for link in "$units"/multi-user.target.wants/zbridge@*.service; do
        [ ! -L "$link" ] || basename "$link"
    done
}

remove() {
    local unit
    # Instances may run without being enabled. The router stops last, because gateways say goodbye on the bus.
    for unit in 'zbridge@*.service' zbridge.service zbridge-recorder.service zbridge-console.service zbridge-router.service; do
        if booted; then systemctl stop "$unit" 2>/dev/null || ! systemctl is-active --quiet "$unit" || die "$unit did not stop: see journalctl -u ${unit%.service}"; fi
    done
    for unit in $(instances) zbridge.service zbridge-recorder.service zbridge-console.service zbridge-router.service; do
        ! has_systemctl || systemctl disable --quiet "$unit" 2>/dev/null || true
    done
    for unit in "${all_units[@]}"; do rm -f "$units/$unit"; done
    rm -rf "$prefix"
    rm -f "$units/zbridge.service.d/serial.conf" /usr/local/bin/zbridge /etc/tmpfiles.d/zbridge.conf
    if booted; then systemctl daemon-reload; systemctl reset-failed 'zbridge*' 2>/dev/null || true; fi
    if [ -n "$purge" ]; then
        rm -rf "$etc" "$units"/zbridge*.service.d /var/lib/zbridge /var/lib/private/zbridge-{recorder,console} /var/lib/zbridge-{recorder,console}
        rm -f /etc/sysusers.d/zbridge.conf
        ! getent passwd zbridge >/dev/null || userdel zbridge
        ! getent group zbridge >/dev/null || groupdel zbridge
        say "removed, with configuration, certificates and logs"
    else
        say "removed; $etc, /var/lib/zbridge and the recordings are kept (--purge removes them)"
    fi
}

check_host() {
    command -v python3 >/dev/null || die "python3 is missing: apt-get install python3-venv"
    python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' || die "$(python3 --version) is too old: 3.11 or newer is needed"
    python3 -c 'import ensurepip, venv' 2>/dev/null || die "python3-venv is missing: apt-get install python3-venv"
    has_systemctl || die "systemd is missing: apt-get install systemd"
}

install_package() {
    local what options=()
    if [ -n "$wheels" ]; then
        [ -e "$wheels" ] || die "--wheels $wheels: no such file" 2
        local folder=$wheels file=''
        if [ -f "$wheels" ]; then
            folder=$(dirname "$wheels") file=$wheels
        else
            file=$(find "$folder" -maxdepth 1 -name 'zbridge-*.whl' | sort -V | tail -n 1)
            [ -n "$file" ] || die "--wheels $wheels: contains no zbridge-*.whl" 2
        fi
        what=$(realpath "$file") options=(--no-index --find-links "$(realpath "$folder")")
    else
        what=$(dirname "$here")
        [ -f "$what/pyproject.toml" ] || die "$what is not a checkout of zbridge: pass --wheels" 2
    fi
    [ -x "$prefix/bin/python" ] || { rm -rf "$prefix"; python3 -m venv "$prefix"; }
    # The same version may have other contents, so the package itself is always reinstalled, its dependencies only if needed.
    "$prefix/bin/pip" install --quiet --disable-pip-version-check --no-input "${options[@]}" --upgrade "$what${extras:+[$extras]}"
    "$prefix/bin/pip" install --quiet --disable-pip-version-check --no-input "${options[@]}" --force-reinstall --no-deps "$what"
    [ "$(readlink -f /usr/local/bin/zbridge)" = "$prefix/bin/zbridge" ] || ln -sfn "$prefix/bin/zbridge" /usr/local/bin/zbridge
    say "installed $("$prefix/bin/pip" list --disable-pip-version-check --format=freeze | grep '^zbridge==') in $prefix"
}

install_files() {
    local unit changed=''
    put "$here/systemd/sysusers.conf" /etc/sysusers.d/zbridge.conf || true
    put "$here/systemd/tmpfiles.conf" /etc/tmpfiles.d/zbridge.conf || true
    systemd-sysusers /etc/sysusers.d/zbridge.conf
    systemd-tmpfiles --create /etc/tmpfiles.d/zbridge.conf
    for unit in "${all_units[@]}"; do
        if put "$here/systemd/$unit" "$units/$unit"; then changed=yes; fi
    done
    if [ -n "$serial" ] && put "$here/systemd/serial.conf" "$units/zbridge.service.d/serial.conf"; then changed=yes; fi
    keep "$here/zenoh/router.toml" "$etc/router.toml" 0644 || true
    keep "$here/systemd/recorder.env" "$etc/recorder.env" 0640 || true
    keep "$here/systemd/console.env" "$etc/console.env" 0640 || true
    if booted && [ -n "$changed" ]; then systemctl daemon-reload; fi
}

up() { # UNIT CONDITION GLOB: enables the unit, and starts it if files match GLOB
    systemctl enable --quiet "$1"
    if ! booted || [ -z "$start" ]; then say "$1: enabled"; return; fi
    if ! compgen -G "$3" >/dev/null; then say "$1: enabled, not started. Once $2, run: systemctl start ${1%.service}"; return; fi
    if systemctl is-active --quiet "$1"; then
        say "$1: already running, left alone"
        return
    fi
    systemctl start "$1" || die "$1 did not start: see journalctl -u ${1%.service} -n 30"
    say "$1: started"
}

if [ -n "$uninstall" ]; then remove; exit 0; fi
check_host
install_package
install_files
[ -z "$router" ] || up zbridge-router.service "the router's bundle is in $etc/router" "$etc/router/key.pem"
up zbridge.service "a robot file is in $etc/robots" "$etc/robots/*.toml"
[ -z "$recorder" ] || up zbridge-recorder.service "the recorder's bundle is in $etc/recorder" "$etc/recorder/key.pem"
[ -z "$console" ] || up zbridge-console.service "the console's bundle and users.toml are in $etc/console" "$etc/console/users.toml"
if booted && systemctl is-active --quiet zbridge.service; then
    sleep 3 # a supervisor loads only code that has not changed for 2 s
    say "running gateways keep their version. To upgrade them: systemctl reload zbridge, then zbridge restart --all"
fi
