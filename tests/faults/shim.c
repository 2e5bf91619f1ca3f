/* Makes file operations of a program fail, for tests: built as a shared library and loaded by LD_PRELOAD.
 *
 * Affects only files under one folder. Whether the n-th call of an operation on a path fails depends on a hash
 * of the seed, the operation, the path and n, so that a run repeats its faults whatever its threads do.
 *
 *   FAULTS_UNDER   the folder; relative paths count as being under it
 *   FAULTS_SEED    a number
 *   FAULTS_RATE    the number of failing calls per 1000; a quarter as many pairs of an operation and a path always fail
 *   FAULTS_NTH     instead of a rate: only the n-th call fails
 *   FAULTS_KILL    the process kills itself before the n-th call that changes a file, or after it if the
 *                  seed is odd
 *   FAULTS_NO_PAUSE  if set, no ENOSPC and no ESTALE, after which the daemon waits for seconds
 *   FAULTS_LOG     a file that receives a line for each fault
 */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum { FD_MAX = 4096, COUNTER_COUNT = 1 << 14 };

static char under[4096], log_path[4096];
static size_t under_length;
static uint64_t seed, rate, nth, kill_at;
static int no_pause;
static _Atomic uint64_t call_count, change_count;
static _Atomic uint32_t counters[COUNTER_COUNT];
static _Atomic uint64_t hash_of_fd[FD_MAX]; /* of the path that a descriptor was opened by; 0: not concerned */

static uint64_t number(const char *name) {
    const char *text = getenv(name);
    return text ? strtoull(text, NULL, 10) : 0;
}

__attribute__((constructor)) static void start(void) {
    const char *folder = getenv("FAULTS_UNDER"), *log = getenv("FAULTS_LOG");
    if (folder) snprintf(under, sizeof under, "%s", folder);
    if (log) snprintf(log_path, sizeof log_path, "%s", log);
    under_length = strlen(under);
    seed = number("FAULTS_SEED");
    rate = number("FAULTS_RATE");
    nth = number("FAULTS_NTH");
    kill_at = number("FAULTS_KILL");
    no_pause = getenv("FAULTS_NO_PAUSE") != NULL;
}

static uint64_t mixed(uint64_t x) {
    x += 0x9e3779b97f4a7c15u;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}

/* 0 where the path is not concerned. Of the names of temporary files the random part does not count. */
static uint64_t hash_of(const char *path) {
    if (!under_length || !path || !*path) return 0;
    if (*path == '/') {
        if (strncmp(path, under, under_length)) return 0;
        path += under_length;
        while (*path == '/') path++;
    }
    const char *end = strstr(path, ".tmp-");
    size_t length = end ? (size_t)(end - path) : strlen(path);
    uint64_t hash = 0xcbf29ce484222325u;
    for (size_t i = 0; i < length; i++) hash = (hash ^ (unsigned char)path[i]) * 0x100000001b3u;
    return hash | 1;
}

static uint64_t hash_of_open(int fd) {
    return 0 <= fd && fd < FD_MAX ? atomic_load(&hash_of_fd[fd]) : 0;
}

static void remember(int fd, uint64_t hash) {
    if (0 <= fd && fd < FD_MAX) atomic_store(&hash_of_fd[fd], hash);
}

static void note(const char *operation, const char *path, int error) {
    if (!*log_path) return;
    char line[4200];
    int length = snprintf(line, sizeof line, "%s %.4000s: %s\n", operation, path ? path : "", error ? strerror(error) : "short");
    int fd = (int)syscall(SYS_openat, AT_FDCWD, log_path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
    if (fd < 0) return;
    syscall(SYS_write, fd, line, (size_t)length);
    syscall(SYS_close, fd);
}

/* The error that a call fails with, 0 if it does not, -1 if it does a part only. */
static int fault(const char *operation, uint64_t path_hash, const char *path, const int *errors) {
    if (!path_hash) return 0;
    uint64_t pair = mixed(seed ^ mixed(path_hash ^ (uint64_t)operation[0] << 8 ^ (uint64_t)operation[1] << 16 ^
                                       (uint64_t)strlen(operation)));
    uint64_t random;
    if (nth) {
        if (atomic_fetch_add(&call_count, 1) + 1 != nth) return 0;
        random = mixed(pair);
    } else {
        if (!rate) return 0;
        uint64_t count = atomic_fetch_add(&counters[pair % COUNTER_COUNT], 1);
        random = mixed(pair);
        if (random % 4000 >= rate) {
            random = mixed(pair + 1 + count);
            if (random % 1000 >= rate) return 0;
        }
    }
    int error_count = 0;
    while (errors[error_count]) error_count++;
    int error = errors[(random >> 20) % (unsigned)error_count];
    if (no_pause && (error == ENOSPC || error == ESTALE)) error = EIO;
    note(operation, path, error == -1 ? 0 : error);
    return error;
}

/* Ends the process, if this call is to be the last that changes something. */
static void change(uint64_t path_hash, int is_after) {
    if (!path_hash || !kill_at) return;
    if ((int)(seed & 1) != is_after) return;
    if (atomic_fetch_add(&change_count, 1) + 1 == kill_at) {
        note("kill", NULL, EINTR);
        syscall(SYS_kill, getpid(), SIGKILL);
        for (;;) pause();
    }
}

#define NEXT(name) \
    static __typeof__(&name) next; \
    if (!next) next = (__typeof__(&name))dlsym(RTLD_NEXT, #name)

#define FAIL_IF(operation, hash, path, ...) \
    do { \
        static const int errors[] = {__VA_ARGS__, 0}; \
        int error = fault(operation, hash, path, errors); \
        if (error) { \
            errno = error; \
            return -1; \
        } \
    } while (0)

/* Opening. */

static int mode_of(int flags, va_list *more) {
    return flags & (O_CREAT | O_TMPFILE) ? va_arg(*more, int) : 0;
}

static int opened(int fd, uint64_t hash) {
    if (fd >= 0) remember(fd, hash);
    return fd;
}

#define OPEN(name) \
    int name(const char *path, int flags, ...) { \
        NEXT(name); \
        va_list more; \
        va_start(more, flags); \
        int mode = mode_of(flags, &more); \
        va_end(more); \
        uint64_t hash = hash_of(path); \
        if (flags & O_CREAT) FAIL_IF("create", hash, path, ENOSPC, EACCES, EIO, ESTALE); \
        else FAIL_IF("open", hash, path, EACCES, EIO, ESTALE); \
        return opened(next(path, flags, mode), hash); \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name) \
    int name(int folder, const char *path, int flags, ...) { \
        NEXT(name); \
        va_list more; \
        va_start(more, flags); \
        int mode = mode_of(flags, &more); \
        va_end(more); \
        uint64_t hash = folder == AT_FDCWD || *path == '/' ? hash_of(path) : hash_of_open(folder) ? hash_of(path) : 0; \
        if (flags & O_CREAT) FAIL_IF("create", hash, path, ENOSPC, EACCES, EIO, ESTALE); \
        else FAIL_IF("open", hash, path, EACCES, EIO, ESTALE); \
        return opened(next(folder, path, flags, mode), hash); \
    }
OPENAT(openat)
OPENAT(openat64)

int close(int fd) {
    NEXT(close);
    remember(fd, 0);
    return next(fd);
}

/* Folders. */

DIR *opendir(const char *path) {
    NEXT(opendir);
    uint64_t hash = hash_of(path);
    static const int errors[] = {EACCES, EIO, ESTALE, 0};
    int error = fault("opendir", hash, path, errors);
    if (error) {
        errno = error;
        return NULL;
    }
    DIR *folder = next(path);
    if (folder) remember(dirfd(folder), hash);
    return folder;
}

#define READDIR(name, entry) \
    struct entry *name(DIR *folder) { \
        NEXT(name); \
        static const int errors[] = {EIO, ESTALE, 0}; \
        int error = fault("readdir", hash_of_open(dirfd(folder)), "a folder", errors); \
        if (error) { \
            errno = error; \
            return NULL; \
        } \
        return next(folder); \
    }
READDIR(readdir, dirent)
READDIR(readdir64, dirent64)

int closedir(DIR *folder) {
    NEXT(closedir);
    remember(dirfd(folder), 0);
    return next(folder);
}

int mkdir(const char *path, mode_t mode) {
    NEXT(mkdir);
    uint64_t hash = hash_of(path);
    FAIL_IF("mkdir", hash, path, ENOSPC, EACCES, EIO);
    return next(path, mode);
}

/* Looking. */

/* Apart, because Rust asks for the status of no path at all to learn whether there is such a call. */
__attribute__((noinline)) static uint64_t hash_of_statx(int folder, const char *path) {
    return path && !*path ? hash_of_open(folder) : hash_of(path);
}

int statx(int folder, const char *restrict path, int flags, unsigned mask, struct statx *restrict found) {
    NEXT(statx);
    uint64_t hash = hash_of_statx(folder, path);
    FAIL_IF("stat", hash, path, EACCES, EIO, ESTALE);
    return next(folder, path, flags, mask, found);
}

#define STAT(name, kind) \
    int name(const char *restrict path, struct kind *restrict found) { \
        NEXT(name); \
        uint64_t hash = hash_of(path); \
        FAIL_IF("stat", hash, path, EACCES, EIO, ESTALE); \
        return next(path, found); \
    }
STAT(stat, stat)
STAT(stat64, stat64)
STAT(lstat, stat)
STAT(lstat64, stat64)

#define FSTAT(name, kind) \
    int name(int fd, struct kind *found) { \
        NEXT(name); \
        FAIL_IF("fstat", hash_of_open(fd), "a descriptor", EIO, ESTALE); \
        return next(fd, found); \
    }
FSTAT(fstat, stat)
FSTAT(fstat64, stat64)

/* Changing names. */

int rename(const char *from, const char *to) {
    NEXT(rename);
    uint64_t hash = hash_of(to);
    FAIL_IF("rename", hash, to, EIO, EACCES, ENOSPC, ESTALE);
    change(hash, 0);
    int result = next(from, to);
    change(hash, 1);
    return result;
}

int link(const char *from, const char *to) {
    NEXT(link);
    uint64_t hash = hash_of(to);
    FAIL_IF("link", hash, to, EIO, EACCES, ENOSPC, ESTALE);
    change(hash, 0);
    int result = next(from, to);
    change(hash, 1);
    return result;
}

int linkat(int from_folder, const char *from, int to_folder, const char *to, int flags) {
    NEXT(linkat);
    uint64_t hash = hash_of(to);
    FAIL_IF("link", hash, to, EIO, EACCES, ENOSPC, ESTALE);
    change(hash, 0);
    int result = next(from_folder, from, to_folder, to, flags);
    change(hash, 1);
    return result;
}

int unlink(const char *path) {
    NEXT(unlink);
    uint64_t hash = hash_of(path);
    FAIL_IF("unlink", hash, path, EIO, EACCES, ESTALE);
    change(hash, 0);
    int result = next(path);
    change(hash, 1);
    return result;
}

/* Contents. */

int fsync(int fd) {
    NEXT(fsync);
    FAIL_IF("fsync", hash_of_open(fd), "a descriptor", EIO, ENOSPC, ESTALE);
    return next(fd);
}

int fdatasync(int fd) {
    NEXT(fdatasync);
    FAIL_IF("fsync", hash_of_open(fd), "a descriptor", EIO, ENOSPC, ESTALE);
    return next(fd);
}

#define FTRUNCATE(name, kind) \
    int name(int fd, kind length) { \
        NEXT(name); \
        FAIL_IF("truncate", hash_of_open(fd), "a descriptor", EIO, ENOSPC); \
        return next(fd, length); \
    }
FTRUNCATE(ftruncate, off_t)
FTRUNCATE(ftruncate64, off64_t)

/* The bytes of a call that may be a short one; -1, with errno, where it fails. */
static ssize_t allowed(const char *operation, int fd, size_t count, const int *errors) {
    int error = fault(operation, hash_of_open(fd), "a descriptor", errors);
    if (error > 0) {
        errno = error;
        return -1;
    }
    return (ssize_t)(error && count > 1 ? count / 2 : count);
}

static const int write_errors[] = {ENOSPC, EIO, -1, ESTALE, 0};
static const int read_errors[] = {EIO, -1, ESTALE, 0};

ssize_t write(int fd, const void *bytes, size_t count) {
    NEXT(write);
    ssize_t part = allowed("write", fd, count, write_errors);
    if (part < 0) return -1;
    uint64_t hash = hash_of_open(fd);
    change(hash, 0);
    ssize_t result = next(fd, bytes, (size_t)part);
    change(hash, 1);
    return result;
}

ssize_t read(int fd, void *bytes, size_t count) {
    NEXT(read);
    ssize_t part = allowed("read", fd, count, read_errors);
    return part < 0 ? -1 : next(fd, bytes, (size_t)part);
}

#define PARTIAL_AT(name, kind, operation, buffer, errors) \
    ssize_t name(int fd, buffer bytes, size_t count, kind offset) { \
        NEXT(name); \
        ssize_t part = allowed(operation, fd, count, errors); \
        return part < 0 ? -1 : next(fd, bytes, (size_t)part, offset); \
    }
PARTIAL_AT(pread, off_t, "read", void *, read_errors)
PARTIAL_AT(pread64, off64_t, "read", void *, read_errors)
PARTIAL_AT(pwrite, off_t, "write", const void *, write_errors)
PARTIAL_AT(pwrite64, off64_t, "write", const void *, write_errors)

ssize_t writev(int fd, const struct iovec *parts, int count) {
    NEXT(writev);
    ssize_t part = allowed("write", fd, (size_t)count, write_errors);
    return part < 0 ? -1 : next(fd, parts, (int)part);
}
