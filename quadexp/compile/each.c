/* A compiled CasADi function at many values of its first argument, into its first result; the other arguments stand. */

typedef long long integer;

typedef struct { /* CFunction of backend.py */
    int (*call)(const double **, double **, integer *, double *, int);
    const double **arguments;
    double **results;
    integer *iw;
    double *w;
} function;

int each(function *f, const double *values, integer size, double *results, integer result_size, integer count) {
    int failed = 0;
    for (integer k = 0; k < count; k++) {
        f->arguments[0] = values + size * k;
        f->results[0] = results + result_size * k;
        failed |= f->call(f->arguments, f->results, f->iw, f->w, 0);
    }
    return failed;
}
