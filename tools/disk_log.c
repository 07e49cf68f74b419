// Logs what processes do to the files below a folder, with its data and in its order; power_cuts.py reads it.
// LD_PRELOAD=disk_log.so DISK_LOG_ROOT=/folder DISK_LOG=/file program
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

struct head { uint64_t kind, time, inode; int64_t at; uint64_t one, two, data; };

static char root[PATH_MAX];
static int log_file = -1;
static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;

__attribute__((constructor)) static void begin(void)
{
    const char *path = getenv("DISK_LOG"), *folder = getenv("DISK_LOG_ROOT");
    if (!path || !folder || strlen(folder) >= sizeof root) return;
    strcpy(root, folder);
    log_file = syscall(SYS_openat, AT_FDCWD, path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
}

// What is done and its note are one step for all threads and processes.
static void hold(void)
{
    struct flock all = {.l_type = F_WRLCK};
    pthread_mutex_lock(&mutex);
    while (fcntl(log_file, F_SETLKW, &all) < 0 && errno == EINTR);
}

static void release(void)
{
    struct flock all = {.l_type = F_UNLCK};
    int kept = errno;
    fcntl(log_file, F_SETLK, &all);
    pthread_mutex_unlock(&mutex);
    errno = kept;
}

static void put(char kind, uint64_t inode, int64_t at, const char *one, const char *two, const void *data, size_t size)
{
    struct timespec now;
    int kept = errno;
    clock_gettime(CLOCK_MONOTONIC, &now);
    struct head head = {kind, now.tv_sec * 1000000000ull + now.tv_nsec, inode, at, strlen(one), strlen(two), size};
    struct iovec parts[] = {{&head, sizeof head}, {(void *)one, head.one}, {(void *)two, head.two}, {(void *)data, size}};
    if (syscall(SYS_writev, log_file, parts, 4) != (ssize_t)(sizeof head + head.one + head.two + size)) abort();
    errno = kept;
}

static int below(const char *path)
{
    size_t size = strlen(root);
    return log_file >= 0 && !strncmp(path, root, size) && (path[size] == '/' || !path[size]);
}

static int link_of(int fd, char *path)
{
    char name[64];
    snprintf(name, sizeof name, "/proc/self/fd/%d", fd);
    ssize_t size = readlink(name, path, PATH_MAX - 1);
    path[size < 0 ? 0 : size] = 0;
    return size > 0;
}

// Whether a path is below the folder; `full` becomes the whole path.
static int known(int folder, const char *path, char *full)
{
    char base[PATH_MAX];
    if (log_file < 0 || !path) return 0;
    if (*path == '/') snprintf(full, PATH_MAX, "%s", path);
    else if (folder == AT_FDCWD ? !getcwd(base, sizeof base) : !link_of(folder, base)) return 0;
    else if (snprintf(full, PATH_MAX, "%s/%s", base, path) >= PATH_MAX) return 0;
    return below(full);
}

static uint64_t inode_at(const char *path) { struct stat s; return lstat(path, &s) ? 0 : s.st_ino; }

static uint64_t inode_of(int fd)
{
    char path[PATH_MAX];
    struct stat s;
    int kept = errno;
    uint64_t found = log_file >= 0 && link_of(fd, path) && below(path) && !fstat(fd, &s) ? s.st_ino : 0;
    errno = kept;
    return found;
}

// Notes bytes of a file as they are now: as a write (W), or to check the log (H: all of it).
static void put_bytes(char kind, uint64_t inode, const char *path, int64_t at, int64_t size)
{
    struct stat s;
    int kept = errno, file = syscall(SYS_openat, AT_FDCWD, path, O_RDONLY | O_CLOEXEC);
    if (file >= 0 && !fstat(file, &s) && S_ISREG(s.st_mode)) {
        if (size < 0) size = s.st_size;
        void *data = malloc(size + 1);
        if (pread(file, data, size, at) == size) put(kind, inode, at, "", "", data, size);
        free(data);
    }
    if (file >= 0) close(file);
    errno = kept;
}

static void put_written(uint64_t inode, int fd, int64_t at, ssize_t size)
{
    char path[64];
    snprintf(path, sizeof path, "/proc/self/fd/%d", fd);
    if (size > 0) put_bytes('W', inode, path, at, size);
}

#define REAL(name) static __typeof__(name) *real; if (!real) real = dlsym(RTLD_NEXT, #name)
// An operation on a name, or on a file that is open, with its note
#define STEP(type, test, call, failed, note) \
    { if (!(test)) return call; hold(); type done = call; if (done != (failed)) { note; } release(); return done; }

// ---------------------------------------------------------------- files

static int opened(int (*real)(int, const char *, int, ...), int folder, const char *path, int flags, mode_t mode)
{
    char full[PATH_MAX];
    if (!(flags & (O_CREAT | O_TRUNC)) || !known(folder, path, full)) return real(folder, path, flags, mode);
    hold();
    uint64_t before = inode_at(full);
    int fd = real(folder, path, flags, mode);
    if (fd >= 0 && !before) put('C', inode_at(full), 0, full, "", "", 0);
    else if (fd >= 0 && flags & O_TRUNC) put('T', before, 0, "", "", "", 0);
    release();
    return fd;
}

#define MODE mode_t mode = 0; if (flags & (O_CREAT | O_TMPFILE)) { va_list more; va_start(more, flags); mode = va_arg(more, int); va_end(more); }
int openat(int folder, const char *path, int flags, ...) { MODE REAL(openat); return opened(real, folder, path, flags, mode); }
int openat64(int folder, const char *path, int flags, ...) { MODE REAL(openat64); return opened(real, folder, path, flags, mode); }
int open(const char *path, int flags, ...) { MODE REAL(openat); return opened(real, AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE REAL(openat64); return opened(real, AT_FDCWD, path, flags, mode); }
int creat(const char *path, mode_t mode) { return open(path, O_CREAT | O_WRONLY | O_TRUNC, mode); }
int creat64(const char *path, mode_t mode) { return open64(path, O_CREAT | O_WRONLY | O_TRUNC, mode); }

// What the C library writes by itself is not seen: power_cuts.py refuses a log that says so.
static void refuse(const char *what, const char *full) { hold(); put('X', 0, 0, what, full, "", 0); release(); }
#pragma GCC diagnostic ignored "-Wmisleading-indentation"
#define FOPEN(name) FILE *name(const char *path, const char *mode) { char full[PATH_MAX]; REAL(name); \
    if (mode && strpbrk(mode, "wa+") && known(AT_FDCWD, path, full)) refuse(#name, full); return real(path, mode); }
FOPEN(fopen) FOPEN(fopen64)
#define MMAP(name, offset_t) void *name(void *a, size_t size, int protection, int flags, int fd, offset_t at) { \
    if (fd >= 0 && flags & MAP_SHARED && protection & PROT_WRITE && inode_of(fd)) refuse(#name, ""); \
    return (void *)syscall(SYS_mmap, a, size, protection, flags, fd, at); }
MMAP(mmap, off_t) MMAP(mmap64, off64_t)

#define HERE(fd, n) (lseek(fd, 0, SEEK_CUR) - (n))
ssize_t write(int fd, const void *data, size_t size) { REAL(write); uint64_t i = inode_of(fd);
    STEP(ssize_t, i, real(fd, data, size), -1, put('W', i, HERE(fd, done), "", "", data, done)) }
ssize_t writev(int fd, const struct iovec *v, int n) { REAL(writev); uint64_t i = inode_of(fd);
    STEP(ssize_t, i, real(fd, v, n), -1, put_written(i, fd, HERE(fd, done), done)) }
#define PWRITE(name, offset_t) ssize_t name(int fd, const void *data, size_t size, offset_t at) { REAL(name); \
    uint64_t i = inode_of(fd); STEP(ssize_t, i, real(fd, data, size, at), -1, put('W', i, at, "", "", data, done)) }
PWRITE(pwrite, off_t) PWRITE(pwrite64, off64_t)
#define PWRITEV(name, offset_t) ssize_t name(int fd, const struct iovec *v, int n, offset_t at) { REAL(name); \
    uint64_t i = inode_of(fd); STEP(ssize_t, i, real(fd, v, n, at), -1, put_written(i, fd, at, done)) }
PWRITEV(pwritev, off_t) PWRITEV(pwritev64, off64_t)
#define SENDFILE(name, offset_t) ssize_t name(int fd, int from, offset_t *at, size_t size) { REAL(name); \
    uint64_t i = inode_of(fd); STEP(ssize_t, i, real(fd, from, at, size), -1, put_written(i, fd, HERE(fd, done), done)) }
SENDFILE(sendfile, off_t) SENDFILE(sendfile64, off64_t)
ssize_t copy_file_range(int from, off64_t *a, int fd, off64_t *b, size_t size, unsigned flags) { REAL(copy_file_range);
    uint64_t i = inode_of(fd); STEP(ssize_t, i, real(from, a, fd, b, size, flags), -1,
        put_written(i, fd, b ? *b - done : HERE(fd, done), done)) }

#define FTRUNCATE(name, offset_t) int name(int fd, offset_t size) { REAL(name); \
    uint64_t i = inode_of(fd); STEP(int, i, real(fd, size), -1, put('T', i, size, "", "", "", 0)) }
FTRUNCATE(ftruncate, off_t) FTRUNCATE(ftruncate64, off64_t)
#define TRUNCATE(name, offset_t) int name(const char *path, offset_t size) { REAL(name); char full[PATH_MAX]; \
    STEP(int, known(AT_FDCWD, path, full), real(path, size), -1, put('T', inode_at(full), size, "", "", "", 0)) }
TRUNCATE(truncate, off_t) TRUNCATE(truncate64, off64_t)
static void put_size(uint64_t i, int fd) { struct stat s; if (!fstat(fd, &s)) put('T', i, s.st_size, "", "", "", 0); }
#define FALLOCATE(name, offset_t) int name(int fd, int mode, offset_t at, offset_t size) { REAL(name); uint64_t i = inode_of(fd); \
    if (i && mode & ~1) refuse(#name, ""); STEP(int, i, real(fd, mode, at, size), -1, put_size(i, fd)) }
FALLOCATE(fallocate, off_t) FALLOCATE(fallocate64, off64_t)
#define POSIX_FALLOCATE(name, offset_t) int name(int fd, offset_t at, offset_t size) { REAL(name); \
    uint64_t i = inode_of(fd); STEP(int, i, real(fd, at, size), -1, put_size(i, fd)) }
POSIX_FALLOCATE(posix_fallocate, off_t) POSIX_FALLOCATE(posix_fallocate64, off64_t)

// What was written before S is on the disk when there is an E. sync_file_range, sync and syncfs are taken for nothing.
static int synced(int (*real)(int), int fd)
{
    char path[64];
    uint64_t i = inode_of(fd);
    if (!i) return real(fd);
    hold();
    snprintf(path, sizeof path, "/proc/self/fd/%d", fd);
    put_bytes('H', i, path, 0, -1);
    put('S', i, gettid(), "", "", "", 0);
    release();
    int done = real(fd);
    hold();
    put(done ? 'F' : 'E', i, gettid(), "", "", "", 0);
    release();
    return done;
}
int fsync(int fd) { REAL(fsync); return synced(real, fd); }
int fdatasync(int fd) { REAL(fdatasync); return synced(real, fd); }

// ---------------------------------------------------------------- names

static int renamed(int a, const char *old, int b, const char *new, unsigned flags)
{
    char from[PATH_MAX], to[PATH_MAX];
    int is_old = known(a, old, from), is_new = known(b, new, to);
    if (is_old != is_new) refuse("rename", is_old ? from : to);
    STEP(int, is_old && is_new, syscall(SYS_renameat2, a, old, b, new, flags), -1, put('R', 0, flags, from, to, "", 0))
}
int rename(const char *old, const char *new) { return renamed(AT_FDCWD, old, AT_FDCWD, new, 0); }
int renameat(int a, const char *old, int b, const char *new) { return renamed(a, old, b, new, 0); }
int renameat2(int a, const char *old, int b, const char *new, unsigned flags) { return renamed(a, old, b, new, flags); }

int linkat(int a, const char *old, int b, const char *new, int flags) { REAL(linkat); char from[PATH_MAX], to[PATH_MAX];
    int is_new = known(b, new, to); if (is_new && !known(a, old, from)) refuse("link", to);
    STEP(int, is_new, real(a, old, b, new, flags), -1, put('L', inode_at(to), 0, to, "", "", 0)) }
int link(const char *old, const char *new) { return linkat(AT_FDCWD, old, AT_FDCWD, new, 0); }
int symlinkat(const char *old, int b, const char *new) { REAL(symlinkat); char to[PATH_MAX];
    if (known(b, new, to)) refuse("symlink", to); return real(old, b, new); }
int symlink(const char *old, const char *new) { return symlinkat(old, AT_FDCWD, new); }

static void checked(const char *full) { if (below(full)) put_bytes('H', inode_at(full), full, 0, -1); }
int unlinkat(int folder, const char *path, int flags) { REAL(unlinkat); char full[PATH_MAX] = "";
    STEP(int, known(folder, path, full), (checked(full), real(folder, path, flags)), -1, put('U', 0, 0, full, "", "", 0)) }
int unlink(const char *path) { return unlinkat(AT_FDCWD, path, 0); }
int rmdir(const char *path) { return unlinkat(AT_FDCWD, path, AT_REMOVEDIR); }
int remove(const char *path) { return unlink(path) ? errno == EISDIR ? rmdir(path) : -1 : 0; }
int mkdirat(int folder, const char *path, mode_t mode) { REAL(mkdirat); char full[PATH_MAX];
    STEP(int, known(folder, path, full), real(folder, path, mode), -1, put('M', inode_at(full), 0, full, "", "", 0)) }
int mkdir(const char *path, mode_t mode) { return mkdirat(AT_FDCWD, path, mode); }
