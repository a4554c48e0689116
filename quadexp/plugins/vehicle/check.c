/* check FOLDER: the controller of this folder against the flight of the bench that lies in it.

   vectors.bin   what the controller was given and answered at each instant: it has to answer the same
   plant.bin     the plant's noise and parameters: controller and plant fly in a closed loop, along the same path
   then          10,000 steps of numbers that nobody should send, after each of which it has to fly on

   check.h says what is to be met. Exit code 1 where something is not. */
#include "controller.h"
#include "check.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef NAME(real) real;
typedef NAME(window) window;
enum { BODY = 13, HOSTILE = 10000 };

typedef struct {
    real state[BODY];
    window reference;
    real force[3], speed[ROTORS], command[ROTORS], status;
} vector;

static FILE *opened(const char *folder, const char *name) {
    char path[4096];
    if (snprintf(path, sizeof path, "%s/%s", folder, name) >= (int)sizeof path) exit(2);
    FILE *file = fopen(path, "rb");
    if (!file) fprintf(stderr, "%s: cannot be read\n", path), exit(2);
    return file;
}

static const real *measured(const real *values) { return isnan(values[0]) ? 0 : values; }

/* The instants of the recorded flight, one by one. */
static int replay(const char *folder) {
    static vector v;
    FILE *file = opened(folder, "vectors.bin");
    double most = 0;
    int steps = 0, other = 0;
    for (; fread(&v, sizeof v, 1, file) == 1; steps++) {
        real command[ROTORS];
        if (!steps && NAME(reset)(v.state, &v.reference)) other++;
        const int status = NAME(step)(v.state, measured(v.force), measured(v.speed), &v.reference, command);
        other += status != (int)v.status;
        for (int i = 0; i < ROTORS; i++) most = fmax(most, fabs((double)command[i] - (double)v.command[i]));
    }
    fclose(file);
    const int fine = steps > 0 && !other && (!REPLAYS || most <= REPLAY_LIMIT);
    printf("replay        %d steps, largest difference %.2g N", steps, most);
    if (REPLAYS) printf(" (at most %.2g)", REPLAY_LIMIT);
    else printf(" (not judged: it learns from its own commands)");
    printf(", other status %d: %s\n", other, fine ? "ok" : "FAILED");
    return fine;
}

#if HAS_PLANT
int check_plant(const double **, double **, PLANT_INTEGER *, double *, int);

static double buffer[PLANT_CONTEXT + 1], first[BODY + INNER + 1 + TOLD];

/* Controller and plant, as they flew. */
static int closed(const char *folder) {
    static vector v;
    static double x[BODY], inner[INNER + 1], u[ROTORS], x_next[BODY], inner_next[INNER + 1], reading[3], told[BODY];
    static double spare[PLANT_SPARE + 1], position[3], w[PLANT_W + 1];
    static PLANT_INTEGER iw[PLANT_IW + 1];
    const double *given[PLANT_ARGUMENTS] = {0};
    double *left[PLANT_RESULTS] = {0};
    FILE *vectors = opened(folder, "vectors.bin"), *plant = opened(folder, "plant.bin");
    double apart = 0, error = 0, error_recorded = 0;
    int steps = 0;
    PLANT_POINTERS
    if (fread(first, sizeof(double), BODY + INNER + TOLD, plant) != BODY + INNER + TOLD) exit(2);
    memcpy(x, first, sizeof x);
    memcpy(inner, first + BODY, sizeof(double) * INNER);
    memcpy(told, TOLD ? first + BODY + INNER : x, sizeof told);
    while (fread(&v, sizeof v, 1, vectors) == 1) {
        real state[BODY], force[3], speed[ROTORS], command[ROTORS];
        for (int i = 0; i < BODY; i++) state[i] = (real)told[i];
        for (int i = 0; i < 3; i++) force[i] = (real)reading[i];
        for (int i = 0; i < ROTORS; i++) speed[i] = TURNS ? (real)inner[turning[i]] : 0;
        if (!steps && NAME(reset)(state, &v.reference)) break;
        NAME(step)(state, steps ? force : 0, steps && TURNS ? speed : 0, &v.reference, command);
        for (int i = 0; i < ROTORS; i++) u[i] = (double)command[i];
        if (fread(buffer, sizeof(double), PLANT_CONTEXT, plant) != PLANT_CONTEXT) break;
        if (fread(position, sizeof(double), 3, plant) != 3) break;
        double recorded = 0, own = 0;
        for (int i = 0; i < 3; i++) {
            const double wanted = (double)v.reference.path[0][i];
            own += (x[i] - wanted) * (x[i] - wanted);
        }
        error += sqrt(own);
        check_plant(given, left, iw, w, 0);
        memcpy(x, x_next, sizeof x);
        memcpy(inner, inner_next, sizeof inner);
        if (!TOLD) memcpy(told, x, sizeof told);
        for (int i = 0; i < 3; i++) recorded = fmax(recorded, fabs(x[i] - position[i]));
        apart = recorded > apart || recorded != recorded ? recorded : apart;
        steps++;
    }
    fclose(vectors), fclose(plant);
    error /= steps ? steps : 1;
    error_recorded = MEAN_ERROR;
    const double allowed = ERROR_SHARE * error_recorded + ROUNDING;
    const int fine = steps > 0 && apart <= PATH_LIMIT && fabs(error - error_recorded) <= allowed;
    printf("closed loop   %d steps, paths at most %.2g m apart (at most %.2g), mean error %.6g mm, of the bench %.6g mm"
           ": %s\n", steps, apart, PATH_LIMIT, 1e3 * error, 1e3 * error_recorded, fine ? "ok" : "FAILED");
    return fine;
}
#endif

static unsigned long seed = 1;
static unsigned below(unsigned count) { /* a generator of Numerical Recipes, the same everywhere */
    seed = (seed * 1664525UL + 1013904223UL) & 0xffffffffUL;
    return (unsigned)(seed >> 8) % count;
}

/* Steps with numbers that nobody should send; between them the recorded flight goes on. */
static int hostile(const char *folder) {
    static const double numbers[] = {NAN, INFINITY, -INFINITY, 1e30, -1e30, 1e9, 1e8, 1e6, 1e3, 50, 11, -11, 5, 0};
    static vector v, bad;
    FILE *file = opened(folder, "vectors.bin");
    int by[3] = {0}, wrong = 0, recovered = 0;
    if (fread(&v, sizeof v, 1, file) != 1) exit(2);
    if (NAME(reset)(v.state, &v.reference)) wrong++;
    bad = v;
    bad.state[0] = (real)NAN;
    if (NAME(reset)(bad.state, &v.reference) == 0 || NAME(reset)(0, &v.reference) == 0) wrong++;
    if (NAME(reset)(v.state, 0) == 0) wrong++;
    real unused[ROTORS];
    if (NAME(step)(v.state, 0, 0, &v.reference, unused) == 0) wrong++; /* no flight has begun */
    if (NAME(reset)(v.state, &v.reference)) wrong++;
    for (int k = 0; k < HOSTILE; k++) {
        real command[ROTORS];
        bad = v;
        const real number = (real)numbers[below(sizeof numbers / sizeof *numbers)];
        const real *force = measured(v.force), *speed = measured(v.speed);
        const window *reference = &bad.reference;
        switch (below(7)) {
        case 0: bad.state[below(BODY)] = number; break;
        case 1: bad.reference.states[below(ROWS)][below(BODY)] = number; break;
        case 2: bad.reference.path[below(5)][below(3)] = number; break;
        case 3: bad.force[below(3)] = number, force = bad.force; break;
        case 4: bad.speed[below(ROTORS)] = number, speed = bad.speed; break;
        case 5: force = 0, speed = 0; break;
        default: if (below(10) == 0) reference = 0; else bad.reference.inputs[0][below(ROTORS)] = number;
        }
        by[NAME(step)(bad.state, force, speed, reference, command)]++;
        for (int i = 0; i < ROTORS; i++) wrong += !isfinite(command[i]);
        if (k % 20 == 19) { /* a flight that begins anew is as if nothing had been */
            if (NAME(reset)(v.state, &v.reference)) wrong++;
            recovered += NAME(step)(v.state, measured(v.force), measured(v.speed), &v.reference, command) == 0;
        }
    }
    fclose(file);
    const int fine = !wrong && recovered == HOSTILE / 20;
    printf("hostile       %d steps: answered %d, refused %d, without an answer %d; wrong %d, flew on %d of %d: %s\n", HOSTILE,
           by[0], by[1], by[2], wrong, recovered, HOSTILE / 20, fine ? "ok" : "FAILED");
    return fine;
}

int main(int count, char **given) {
    const char *folder = count > 1 ? given[1] : ".";
    int fine = replay(folder);
#if HAS_PLANT
    fine &= closed(folder);
#endif
    fine &= hostile(folder);
    return !fine;
}
