#!/usr/bin/env bash
# apart.sh FOLDER COMMAND...: runs a command that sees devices and a /run of its own; the namespace of mounts was made by deploy/try.sh.
# Why: runtimes of containers give the devices that they are handed, /dev/null among them, to the container's user.
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

# The standard input that was opened before may be the machine's own /dev/null.
exec "$@" </dev/null
