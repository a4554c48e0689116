/* What the C library asks of a system, for programs in an emulator that allocate. */
#ifdef __cplusplus
extern "C" {
#endif
int t_heap; /* bytes that were allocated */
static char heap[200000] __attribute__((section(".noinit")));

void *_sbrk(int size) {
    void *place = heap + t_heap;
    t_heap += size;
    return place;
}
void _exit(int code) { (void)code; for (;;); }
int _write(int file, char *data, int count) { return (void)file, (void)data, count; }
int _read(int file, char *data, int count) { return (void)file, (void)data, (void)count, 0; }
int _close(int file) { return (void)file, -1; }
int _lseek(int file, int place, int from) { return (void)file, (void)place, (void)from, 0; }
int _fstat(int file, void *about) { return (void)file, (void)about, 0; }
int _isatty(int file) { return (void)file, 1; }
int _kill(int process, int signal) { return (void)process, (void)signal, 0; }
int _getpid(void) { return 1; }
#ifdef __cplusplus
}
#endif
