/* Preloaded into a Betaflight SITL, which stays as it is: its clock stands still until the simulator grants time.

   CLOCK_MONOTONIC is virtual. The main thread's nanosleep moves it; where what was granted is used up, it says so with
   one byte on the socket LOCKSTEP, and waits for the next end of time (8 bytes, ns). The threads that receive packets
   say with one byte each that a packet has been taken in: before they look for the next one.

   One thread runs at a time, and gives its turn away where it waits: the firmware's library for TCP is not safe for
   threads, and on a busy machine it loses its port, or answers, where the main thread interrupts it. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { STATE = 144, CHANNELS = 40 }; /* bytes of the packets that are waited for */

static volatile int64_t now, granted; /* ns */
static int simulator = -1;
static pthread_t main_thread;
static __thread int taken;
static pthread_mutex_t turn = PTHREAD_MUTEX_INITIALIZER;

__attribute__((constructor)) static void begin(void) {
    const char *descriptor = getenv("LOCKSTEP");
    main_thread = pthread_self();
    if (descriptor) simulator = atoi(descriptor);
    pthread_mutex_lock(&turn);
}

static void say(char what) {
    if (write(simulator, &what, 1) != 1) _exit(0); /* the simulator has ended */
}

typedef struct {
    void *(*routine)(void *);
    void *argument;
} task;

static void *in_turn(void *given) {
    const task work = *(task *)given;
    free(given);
    pthread_mutex_lock(&turn);
    void *result = work.routine(work.argument);
    pthread_mutex_unlock(&turn);
    return result;
}

int pthread_create(pthread_t *thread, const pthread_attr_t *attributes, void *(*routine)(void *), void *argument) {
    static int (*original)(pthread_t *, const pthread_attr_t *, void *(*)(void *), void *);
    if (!original) original = dlsym(RTLD_NEXT, "pthread_create");
    task *work = malloc(sizeof *work);
    if (!work) abort();
    *work = (task){routine, argument};
    return original(thread, attributes, in_turn, work);
}

int pthread_join(pthread_t thread, void **result) {
    static int (*original)(pthread_t, void **);
    if (!original) original = dlsym(RTLD_NEXT, "pthread_join");
    pthread_mutex_unlock(&turn);
    const int status = original(thread, result);
    pthread_mutex_lock(&turn);
    return status;
}

ssize_t recvfrom(int file, void *data, size_t size, int flags, struct sockaddr *from, socklen_t *length) {
    static ssize_t (*original)(int, void *, size_t, int, struct sockaddr *, socklen_t *);
    if (!original) original = dlsym(RTLD_NEXT, "recvfrom");
    const ssize_t count = original(file, data, size, flags, from, length);
    taken = count == STATE || count == CHANNELS;
    return count;
}

int select(int count, fd_set *read_set, fd_set *write_set, fd_set *error_set, struct timeval *patience) {
    static int (*original)(int, fd_set *, fd_set *, fd_set *, struct timeval *);
    if (!original) original = dlsym(RTLD_NEXT, "select");
    if (taken && simulator >= 0) say('p');
    taken = 0;
    pthread_mutex_unlock(&turn);
    const int ready = original(count, read_set, write_set, error_set, patience);
    pthread_mutex_lock(&turn);
    return ready;
}

int clock_gettime(clockid_t which, struct timespec *time) {
    static int (*original)(clockid_t, struct timespec *);
    if (!original) original = dlsym(RTLD_NEXT, "clock_gettime");
    if (simulator < 0 || which != CLOCK_MONOTONIC) return original(which, time);
    time->tv_sec = now / 1000000000;
    time->tv_nsec = now % 1000000000;
    return 0;
}

int nanosleep(const struct timespec *asked, struct timespec *left) {
    static int (*original)(const struct timespec *, struct timespec *);
    if (!original) original = dlsym(RTLD_NEXT, "nanosleep");
    if (simulator < 0 || !pthread_equal(pthread_self(), main_thread)) return original(asked, left);
    int64_t rest = (int64_t)asked->tv_sec * 1000000000 + asked->tv_nsec;
    while (rest > 0) {
        const int64_t part = granted - now < rest ? granted - now : rest;
        now += part;
        rest -= part;
        if (now < granted) continue;
        int64_t end;
        pthread_mutex_unlock(&turn);
        say('t');
        if (recv(simulator, &end, sizeof end, MSG_WAITALL) != sizeof end) _exit(0);
        pthread_mutex_lock(&turn);
        granted = end;
    }
    return 0;
}
