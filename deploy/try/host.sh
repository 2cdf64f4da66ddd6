#!/usr/bin/env bash
# Tests install.sh on a bare Debian host: in a chroot without systemd and network, then booted by systemd (systemd-nspawn). Usage: host.sh FOLDER
# shellcheck source-path=SCRIPTDIR disable=SC2015
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
as_root
need mmdebstrap mmdebstrap
need systemd-nspawn systemd-container
wheel "$work/wheels" "${root}[certs,serial,foxglove]"

other() { # VERSION: builds the wheel of another version from the code in $work/VERSION
    sed -i "s/^version = .*/version = \"$1\"/" "$work/$1/pyproject.toml"
    wheel "$work/later-$1" --no-deps "$work/$1"
}
for version in 0.2.1 0.2.2; do
    mkdir "$work/$version"
    mkdir -p "$work/$version/deploy/release"
    cp -r "$root"/{pyproject.toml,README.md,LICENSE,zbridge,gateways} "$work/$version/"
    cp "$root/deploy/release/zbridge.cdx.json" "$work/$version/deploy/release/"
done
# 0.2.1 is recognized by what its gateways answer; the gateways of 0.2.2 do not start.
sed -i 's/; version=0.0.4/; version=0.0.4; zbridge=0.2.1/' "$work/0.2.1/zbridge/app/prometheus.py"
echo 'raise RuntimeError("a broken version")' >>"$work/0.2.2/zbridge/app/gateway.py"
other 0.2.1
other 0.2.2

host=$work/host
debian "$host" ca-certificates,systemd,systemd-sysv,dbus,python3-venv,iproute2,procps
mkdir "$host/root/try"
cp -r "$root/deploy" "$work/wheels" "$work"/later-* "$host/root/try/"
clean=(env -i PATH=/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin HOME=/root)

echo "-- a chroot"
listing() { (cd "$host" && find . -path ./root -prune -o -path ./proc -prune -o -print | sort); }
listing >"$work/before"
install() { # ARGUMENTS: runs install.sh without a network
    unshare --net --mount --pid --fork --mount-proc="$host/proc" "${clean[@]}" chroot "$host" bash /root/try/deploy/install.sh "$@"
}
for round in first second; do
    install --wheels /root/try/wheels --router --recorder >"$work/$round" 2>&1 || { cat "$work/$round"; fail "$round run of install.sh"; }
    listing >"$work/after-$round"
done
grep -q "wrote /etc/systemd/system/zbridge.service" "$work/first" || fail "the first run wrote no unit"
! grep "wrote" "$work/second" || fail "the second run wrote files"
diff "$work/after-first" "$work/after-second" || fail "the second run changed the set of files"
"${clean[@]}" chroot "$host" zbridge check /dev/null >/dev/null 2>&1 || [ $? -eq 2 ] || fail "zbridge does not run"
"${clean[@]}" chroot "$host" /opt/zbridge/bin/python -c 'import mcap, serial, cryptography' || fail "an extra is missing"
ok "installs without a network; the second run changes nothing"
install --uninstall >"$work/log" || { cat "$work/log"; fail "--uninstall"; }
[ -d "$host/etc/zbridge/bus" ] && [ ! -e "$host/opt/zbridge" ] || fail "--uninstall removed the configuration, or left /opt/zbridge"
for round in first second; do install --uninstall --purge >"$work/log" || { cat "$work/log"; fail "$round run of --purge"; }; done
listing | comm -13 "$work/before" - | grep -v -e '^./var/log' -e '^./etc/.*-$' -e '^./usr/lib/python3' -e '^./etc/sysusers.d$' >"$work/left" || true
[ ! -s "$work/left" ] || { cat "$work/left"; fail "--uninstall --purge left files"; }
ok "--uninstall keeps the configuration, --purge leaves nothing; a second run does no harm"

echo "-- a booted host, with a network of its own"
ungroup() { # removes the control groups that systemd-nspawn leaves in its caller's, because it does not start if some of them exist
    local controllers path group
    while IFS=: read -r _ controllers path; do
        case $controllers in
            '') set -- "/sys/fs/cgroup$path" "/sys/fs/cgroup/unified$path" ;;
            name=systemd) set -- "/sys/fs/cgroup/systemd$path" ;;
            *) continue ;;
        esac
        for group in "${@/%//payload}" "${@/%//supervisor}"; do
            [ ! -d "$group" ] || find "$group" -depth -type d -exec rmdir {} \; 2>/dev/null || true
        done
    done </proc/self/cgroup
}
nspawn='' init=''
over() {
    [ -z "$nspawn" ] || kill "$nspawn" 2>/dev/null || true
    [ -z "$nspawn" ] || wait "$nspawn" 2>/dev/null || true
    ungroup
}
trap over EXIT
inside() { nsenter --target "$init" --mount --pid --uts --ipc --net --cgroup "${clean[@]}" "$@"; }
boot() {
    local state=''
    ungroup
    systemd-nspawn --quiet --boot --directory="$host" --register=no --keep-unit --private-network --console=pipe </dev/null >"$work/console" 2>&1 &
    nspawn=$!
    for _ in $(seq 120); do
        init=$(pgrep --parent "$nspawn" --exact systemd | head -n 1 || true)
        [ -z "$init" ] || state=$(inside systemctl is-system-running 2>/dev/null || true)
        case $state in running | degraded) return 0 ;; esac
        kill -0 "$nspawn" 2>/dev/null || break
        sleep 0.5
    done
    tail -n 5 "$work/console"
    return 1
}
boot || { echo "systemd does not boot in a container here"; exit 77; }
inside bash /root/try/deploy/try/inside.sh /root/try started failing upgraded observed
inside systemctl reboot || true
code=0
wait "$nspawn" || code=$?
[ $code -eq 133 ] || fail "systemd-nspawn exited with $code; expected 133, a request to boot again"
boot || fail "the host did not boot again"
inside bash /root/try/deploy/try/inside.sh /root/try booted removed
