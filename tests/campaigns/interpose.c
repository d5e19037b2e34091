/* Counts every operation that changes files below a folder, and ends the process at one of them.

   Loaded with LD_PRELOAD, so that what C++ libraries write is counted too. Nothing happens before interpose_arm. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

#undef open64
#undef openat64
#undef pwrite64

enum { BEFORE, AFTER, HALF, FULL }; /* FULL: from this operation on the disk is full */

static char folder[PATH_MAX];
static size_t folder_length;
static int mode, log_file = -1;
static atomic_long counted, target;
static __thread int inside;

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

void interpose_arm(const char *path, long at, int how, const char *log) {
    snprintf(folder, sizeof folder, "%s", path);
    log_file = open(log, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0666);
    mode = how;
    target = at;
    counted = 0;
    folder_length = strlen(folder); /* last: now it counts */
}

static int below(int base, const char *path) {
    char place[PATH_MAX + 1], link[64];
    if (!folder_length) return 0;
    if (!path || path[0] != '/') {
        if (base == AT_FDCWD) snprintf(link, sizeof link, "/proc/self/cwd");
        else snprintf(link, sizeof link, "/proc/self/fd/%d", base);
        ssize_t length = readlink(link, place, sizeof place - 1);
        if (length < 0) return 0;
        place[length] = 0;
        if (path) strncat(strncat(place, "/", sizeof place - strlen(place) - 1), path, sizeof place - strlen(place) - 1);
        path = place;
    }
    return !strncmp(path, folder, folder_length) && (path[folder_length] == '/' || !path[folder_length]);
}

static void end(void) {
    kill(getpid(), SIGKILL);
    for (;;) pause();
}

/* The number of this operation, or 0 where it is not counted. Ends the process before it if so asked. */
static long begin(const char *name, int base, const char *path, int writes) {
    int kept = errno;
    if (inside || !below(base, path)) { errno = kept; return 0; }
    inside = 1;
    long number = ++counted;
    dprintf(log_file, "%ld %s %s\n", number, name, path ? path : "-");
    if (number == target && (mode == BEFORE || (mode == HALF && !writes))) end();
    inside = 0, errno = kept;
    return number;
}

static int full(long number) { return number && mode == FULL && target && number >= target ? (errno = ENOSPC, 1) : 0; }
static void after(long number) { if (number && number == target && mode != FULL) end(); }
#define HALVED(number, size) (number && number == target && mode == HALF ? (size) / 2 : (size))

#define CALL(type, name, base, path, parameters, arguments)                  \
    type name parameters {                                                   \
        long number = begin(#name, base, path, 0);                           \
        if (full(number)) return -1;                                         \
        type result = REAL(name) arguments;                                  \
        after(number);                                                       \
        return result;                                                       \
    }
/* Making room and flushing are no writing: a full disk lets them pass. */
#define FREE(type, name, base, path, parameters, arguments)                  \
    type name parameters {                                                   \
        long number = begin(#name, base, path, 0);                           \
        type result = REAL(name) arguments;                                  \
        after(number);                                                       \
        return result;                                                       \
    }
#define WRITE(name, parameters, arguments)                                   \
    ssize_t name parameters {                                                \
        long number = begin(#name, file, NULL, 1);                           \
        if (full(number)) return -1;                                         \
        size = HALVED(number, size);                                         \
        ssize_t result = REAL(name) arguments;                               \
        after(number);                                                       \
        return result;                                                       \
    }
#define OPEN(name, base, parameters, arguments)                              \
    int name parameters {                                                    \
        mode_t bits = 0;                                                     \
        va_list rest;                                                        \
        va_start(rest, flags);                                               \
        if (flags & (O_CREAT | O_TMPFILE)) bits = va_arg(rest, mode_t);      \
        va_end(rest);                                                        \
        long number = flags & (O_CREAT | O_TRUNC) ? begin(#name, base, path, 0) : 0; \
        if (full(number)) return -1;                                         \
        int result = REAL(name) arguments;                                   \
        after(number);                                                       \
        return result;                                                       \
    }

OPEN(open, AT_FDCWD, (const char *path, int flags, ...), (path, flags, bits))
OPEN(open64, AT_FDCWD, (const char *path, int flags, ...), (path, flags, bits))
OPEN(openat, base, (int base, const char *path, int flags, ...), (base, path, flags, bits))
OPEN(openat64, base, (int base, const char *path, int flags, ...), (base, path, flags, bits))
WRITE(write, (int file, const void *bytes, size_t size), (file, bytes, size))
WRITE(pwrite, (int file, const void *bytes, size_t size, off_t at), (file, bytes, size, at))
WRITE(pwrite64, (int file, const void *bytes, size_t size, off64_t at), (file, bytes, size, at))
WRITE(writev, (int file, const struct iovec *bytes, int size), (file, bytes, size))
CALL(int, mkdir, AT_FDCWD, path, (const char *path, mode_t bits), (path, bits))
CALL(int, mkdirat, base, path, (int base, const char *path, mode_t bits), (base, path, bits))
CALL(int, rename, AT_FDCWD, to, (const char *from, const char *to), (from, to))
CALL(int, renameat, second, to, (int first, const char *from, int second, const char *to), (first, from, second, to))
CALL(int, renameat2, second, to, (int first, const char *from, int second, const char *to, unsigned flags),
     (first, from, second, to, flags))
CALL(int, link, AT_FDCWD, to, (const char *from, const char *to), (from, to))
CALL(int, linkat, second, to, (int first, const char *from, int second, const char *to, int flags),
     (first, from, second, to, flags))
CALL(int, symlink, AT_FDCWD, to, (const char *from, const char *to), (from, to))
FREE(int, unlink, AT_FDCWD, path, (const char *path), (path))
FREE(int, unlinkat, base, path, (int base, const char *path, int flags), (base, path, flags))
FREE(int, rmdir, AT_FDCWD, path, (const char *path), (path))
FREE(int, fsync, file, NULL, (int file), (file))
FREE(int, fdatasync, file, NULL, (int file), (file))
FREE(int, ftruncate, file, NULL, (int file, off_t size), (file, size))
FREE(int, ftruncate64, file, NULL, (int file, off64_t size), (file, size))
