#!/usr/bin/env bash
# install.sh on a bare Debian host: in a chroot without systemd and network, then on one that systemd booted (systemd-nspawn).
# shellcheck source-path=SCRIPTDIR disable=SC2154
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
as_root
need mmdebstrap mmdebstrap
need systemd-nspawn systemd-container
wheels

host=$work/host
debian "$host" ca-certificates,systemd,systemd-sysv,dbus,python3-venv,iproute2,procps
cp -r "$root/deploy" "$work/wheels" "$host/root/"
clean=(env -i PATH=/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin HOME=/root)

echo "-- a chroot"
listing() { (cd "$host" && find . -path ./root -prune -o -path ./proc -prune -o -print | sort); }
listing >"$work/before"
for round in first second; do
    unshare --net --mount --pid --fork --mount-proc="$host/proc" "${clean[@]}" chroot "$host" bash /root/deploy/install.sh --wheels /root/wheels --router --recorder >"$work/$round" 2>&1 \
        || { cat "$work/$round"; fail "install.sh, $round time"; }
done
grep -q "wrote /etc/systemd/system/zbridge.service" "$work/first" || fail "the first time writes no unit"
! grep "wrote" "$work/second" || fail "the second time writes something"
"${clean[@]}" chroot "$host" zbridge check /dev/null >/dev/null 2>&1 || [ $? -eq 2 ] || fail "zbridge does not run"
ok "installs without a network; the second time changes nothing"
"${clean[@]}" chroot "$host" bash /root/deploy/install.sh --uninstall --purge >/dev/null || fail "--uninstall"
listing | comm -13 "$work/before" - | grep -v -e '^./var/log' -e '^./etc/.*-$' -e '^./usr/lib/python3' -e '^./etc/sysusers.d$' >"$work/left" || true
[ ! -s "$work/left" ] || { cat "$work/left"; fail "--uninstall --purge leaves files"; }
ok "--uninstall --purge leaves nothing"

echo "-- a booted host, with a network of its own"
systemd-nspawn --quiet --boot --directory="$host" --register=no --keep-unit --private-network --console=pipe </dev/null >"$work/console" 2>&1 &
nspawn=$!
trap 'kill $nspawn 2>/dev/null || true; wait $nspawn 2>/dev/null || true' EXIT
inside() { nsenter --target "$init" --mount --pid --uts --ipc --net --cgroup "${clean[@]}" "$@"; }
state='' init=''
for _ in $(seq 60); do
    init=$(pgrep --parent $nspawn --exact systemd | head -n 1 || true)
    [ -z "$init" ] || state=$(inside systemctl is-system-running 2>/dev/null || true)
    case $state in running | degraded) break ;; esac
    kill -0 $nspawn 2>/dev/null || break
    sleep 0.5
done
case $state in running | degraded) ;; *) tail -n 5 "$work/console"; echo "systemd does not boot in a container here"; exit 77 ;; esac
inside bash /root/deploy/try/inside.sh
