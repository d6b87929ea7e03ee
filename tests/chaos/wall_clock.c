/* Loaded before libc by LD_PRELOAD: adds whole seconds, which the file of WALL_CLOCK holds as int64_t, to
   CLOCK_REALTIME. All other clocks are the kernel's. The kernel's own wall clock does not step, so a wait by it
   could not be judged: a process that begins one is ended. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static int (*kernel_gettime)(clockid_t, struct timespec *);
static int (*kernel_nanosleep)(clockid_t, int, const struct timespec *, struct timespec *);
static const volatile int64_t *offset_s;

__attribute__((constructor)) static void load(void) {
    kernel_gettime = dlsym(RTLD_NEXT, "clock_gettime");
    kernel_nanosleep = dlsym(RTLD_NEXT, "clock_nanosleep");
    int file = open(getenv("WALL_CLOCK"), O_RDONLY);
    offset_s = mmap(NULL, sizeof *offset_s, PROT_READ, MAP_SHARED, file, 0);
    close(file);
    if (offset_s == MAP_FAILED) abort();
}

int clock_gettime(clockid_t clock, struct timespec *now) {
    if (!offset_s) load(); /* called by the constructor of another library */
    int code = kernel_gettime(clock, now);
    if (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE) now->tv_sec += *offset_s;
    return code;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec precise;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &precise);
    *now = (struct timeval){precise.tv_sec, precise.tv_nsec / 1000};
    return 0;
}

time_t time(time_t *kept) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (kept) *kept = now.tv_sec;
    return now.tv_sec;
}

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *until, struct timespec *left) {
    if (clock == CLOCK_REALTIME && flags & TIMER_ABSTIME) abort();
    return kernel_nanosleep(clock, flags, until, left);
}

int sem_timedwait(sem_t *restrict semaphore, const struct timespec *restrict until) { abort(); }
