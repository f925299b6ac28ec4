"""What Windows does not have is removed from each Python process whose PYTHONPATH has this folder, and its children.

Python imports this module at its start, before anything of ours or of our dependencies.
"""

import os
import select
import signal
import subprocess  # chooses by the platform, before it seems to be another
import sys
from collections.abc import Collection
from typing import Any

MODULES = ("fcntl", "grp", "posix_ipc", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty", "uvloop")
OF_OS = (
    *("chown", "chroot", "confstr", "fchmod", "fchown", "fdatasync", "fork", "forkpty", "getegid", "geteuid", "getgid"),
    *("getgroups", "getloadavg", "getpgid", "getpgrp", "getpriority", "getresuid", "getsid", "getuid", "killpg"),
    *("mkfifo", "mknod", "nice", "openpty", "pathconf", "posix_fadvise", "posix_fallocate", "posix_spawn", "pread"),
    *(
        "pwrite",
        "readv",
        "sched_getaffinity",
        "sched_setaffinity",
        "sched_yield",
    ),
    *("setpriority", "setsid", "setuid", "statvfs", "sync", "sysconf", "wait", "wait3", "wait4", "writev"),
    *("O_DIRECTORY", "O_NOFOLLOW", "O_CLOEXEC", "O_NONBLOCK", "execv"),
)
OF_SIGNAL = (
    *("SIGALRM", "SIGCHLD", "SIGCONT", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGQUIT", "SIGSTOP", "SIGTSTP", "SIGUSR1"),
    *("SIGUSR2", "alarm", "pause", "pthread_kill", "pthread_sigmask", "setitimer", "sigpending", "siginterrupt"),
    *("sigtimedwait", "sigwait", "sigwaitinfo"),
)

for absent in MODULES:
    sys.modules[absent] = None  # type: ignore[assignment] - which makes an import of it fail
for module, names in ((os, OF_OS), (signal, OF_SIGNAL), (select, ("poll", "epoll", "kqueue"))):
    for name in names:
        if hasattr(module, name):
            delattr(module, name)


class _Popen(subprocess.Popen):
    def __init__(self, *arguments: Any, pass_fds: Collection[int] = (), **options: Any) -> None:
        if pass_fds:
            raise ValueError("pass_fds not supported on Windows.")
        super().__init__(*arguments, **options)


subprocess.Popen = _Popen
