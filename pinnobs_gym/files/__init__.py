"""Atomic writing of files, also when several processes write them at once.

- `replacing` writes a new file under a temporary name and renames it when it is complete. Readers
  see either the old file or the new one. `replacing_folder` does the same with a folder.
- What cannot be written raises `CannotWrite`. `noticing_full_disks` raises it in place of what
  other libraries raise on a full disk.
- `check_writable` checks before a long computation that its results can be written.
- `check_ends` refuses devices, which could be read for ever.
- `locked` opens a file for appending by one process and thread at a time; `write_whole` then
  appends all of the data or nothing, and a full disk leaves the file unchanged. `append_lines` does
  both for JSON lines.
- `holding` and `is_held` tell whether the process that owns a path is alive.

Temporary names cannot be predicted and are created exclusively, so that in a folder that others can
write to no link takes their place. New files have the permissions that the umask leaves. What is
`durable` is on the disk before it takes its name: after a power cut there is the old file or the
new one.

A file ``name`` is locked through an empty file ``.name.lock`` beside it, since on Windows a locked
file cannot even be read. The lock is the operating system's (``flock``, or ``LockFileEx`` on
Windows; the package filelock uses either). It is released when a process ends in any way, so that a
killed process blocks nobody. It works between machines if their shared folder supports locks, as
NFS and SMB do. On a system without such locks, filelock uses a file with the id of the process that
created it, and recognises a dead process on the same machine.
"""

from pinnobs_gym.files.appending import (
    append_lines,
    holding,
    is_held,
    json_line,
    locked,
    write_whole,
)
from pinnobs_gym.files.names import file_name
from pinnobs_gym.files.reading import check_ends
from pinnobs_gym.files.writing import (
    CannotWrite,
    cannot_write,
    check_writable,
    noticing_full_disks,
    replacing,
    replacing_folder,
)

__all__ = [
    "CannotWrite",
    "append_lines",
    "cannot_write",
    "check_ends",
    "check_writable",
    "file_name",
    "holding",
    "is_held",
    "json_line",
    "locked",
    "noticing_full_disks",
    "replacing",
    "replacing_folder",
    "write_whole",
]
