#!/usr/bin/env bash
# apart.sh FOLDER COMMAND...: runs a command with devices and a /run of its own, in the mount namespace that deploy/try.sh made.
# Reason: container runtimes change the owner of the devices that they pass to a container, including /dev/null.
set -euo pipefail
new=${1:?usage: apart.sh FOLDER COMMAND...}/dev
shift

mkdir "$new"
mount -t tmpfs -o mode=755,nosuid devices "$new"
umask 0
while read -r name major minor; do mknod --mode=666 "$new/$name" c "$major" "$minor"; done <<'NODES'
null 1 3
zero 1 5
full 1 7
random 1 8
urandom 1 9
tty 5 0
NODES
umask 022
mkdir "$new/pts" "$new/shm"
mount -t devpts -o newinstance,ptmxmode=0666,mode=620 pseudo-terminals "$new/pts"
mount -t tmpfs -o mode=1777,nosuid,nodev shared "$new/shm"
ln -s pts/ptmx "$new/ptmx"
ln -s /proc/self/fd "$new/fd"
for number in 0:stdin 1:stdout 2:stderr; do ln -s "/proc/self/fd/${number%:*}" "$new/${number#*:}"; done
mount --move "$new" /dev
rmdir "$new"
mount -t tmpfs -o mode=755,nosuid,nodev run /run

# The inherited standard input may be the machine's own /dev/null.
exec "$@" </dev/null
