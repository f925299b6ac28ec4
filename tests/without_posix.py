"""Runs a script, or a function that returns an exit status, without what Windows does not have.

    python tests/without_posix.py SCRIPT.py|MODULE:FUNCTION ARGUMENT...

They are removed before anything of ours or of our dependencies is imported.
"""

import importlib
import os
import runpy
import select
import signal
import subprocess  # noqa: F401 - chooses by the platform, before it seems to be another
import sys

MODULES = ("fcntl", "grp", "posix_ipc", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty", "uvloop")
OF_OS = (
    *("chown", "chroot", "confstr", "fchmod", "fchown", "fdatasync", "fork", "forkpty", "getegid", "geteuid", "getgid"),
    *("getgroups", "getloadavg", "getpgid", "getpgrp", "getpriority", "getresuid", "getsid", "getuid", "killpg"),
    *("mkfifo", "mknod", "nice", "openpty", "pathconf", "posix_fadvise", "posix_fallocate", "posix_spawn", "pread"),
    *(
        "pwrite",
        "readv",
        "register_at_fork",
        "sched_getaffinity",
        "sched_setaffinity",
        "sched_yield",
    ),
    *("setpriority", "setsid", "setuid", "statvfs", "sync", "sysconf", "wait", "wait3", "wait4", "writev"),
    *("O_DIRECTORY", "O_NOFOLLOW", "O_CLOEXEC", "O_NONBLOCK", "WNOHANG", "execv"),
)
OF_SIGNAL = (
    *("SIGALRM", "SIGCHLD", "SIGCONT", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGQUIT", "SIGSTOP", "SIGTSTP", "SIGUSR1"),
    *("SIGUSR2", "alarm", "pause", "pthread_kill", "pthread_sigmask", "setitimer", "sigpending", "siginterrupt"),
    *("sigtimedwait", "sigwait", "sigwaitinfo"),
)

if __name__ == "__main__":
    for absent in MODULES:
        sys.modules[absent] = None  # type: ignore[assignment] - which makes an import of it fail
    for module, names in ((os, OF_OS), (signal, OF_SIGNAL), (select, ("poll", "epoll", "kqueue"))):
        for name in names:
            if hasattr(module, name):
                delattr(module, name)
    sys.argv = sys.argv[1:]
    found, _, function = sys.argv[0].partition(":")
    if not function:
        runpy.run_path(found, run_name="__main__")
    else:
        raise SystemExit(getattr(importlib.import_module(found), function)())
