/* The posterior of posterior.py in C, on the same arguments and results, coarse and fine. Freestanding C11:
   no allocation, of libraries only math.h. Before it stand the settings, see `kernel_source` there. */
#include <math.h>

#ifndef REAL
#define REAL double
#endif
#ifndef SUM
#define SUM REAL /* of the moments and of what is made of them: an error is the small difference of large sums */
#endif
#ifndef INTEGER
#define INTEGER long long
#endif
typedef REAL number; /* of all other arguments and results */
typedef SUM real;
typedef INTEGER integer;

enum { LATE, PROMPT, BETWEEN };
enum { GYRO, THRUST, VELOCITY, ATTITUDE, WEIGHTS, LATERAL, CENTRE, MODELS, ROUNDS };
enum { MODE, CHOSEN, ODDS, AT_END, MOVED, MEAN, DEVIATION, LOWER, UPPER, NEWER };
enum { A, D, L, R, BIAS = 3, COLUMNS = 1 + READINGS + BIAS, BLOCK = COMMANDS + 3, MEANS = 3 };

typedef struct { /* low, high: between them hypotheses count. times: of a - r + D */
    real low[4], high[4], step[4], total_low, times_low, times_high;
    int size[4], olds, times;
} grid;

typedef struct { /* of a filter that commands drive; totals: count of them from low on, `shift` later */
    real low, step, shift, span, deviation, numbers;
    int count;
} channel;

typedef struct { /* where the weights of a hypothesis begin, the first two, and the first of the tail */
    int first, possible;
    real h[3];
} head;

static const real *moments(const number *given) { return (const void *)given; }
static real larger(real a, real b) { return a > b ? a : b; }
static real smaller(real a, real b) { return a < b ? a : b; }
static real at(const grid *g, int of, int i) { return g->low[of] + g->step[of] * (real)i; }
static int inside(const grid *g, int of, int i) { return at(g, of, i) < g->high[of] + INSTANT; }

static real integral(real x, real lag) { return x > 0 ? x + lag * (exp(-x / lag) - 1) : 0; }

static real response(real x, real lag, real span) {
    if (span <= INSTANT) return x > 0 ? 1 - exp(-x / lag) : 0;
    return (integral(x, lag) - integral(x - span, lag)) / span;
}

/* responses.py: command_weights */
static void command_weights(real *h, real total, real lag, real span) {
    const real wait = larger(total - lag, 0);
    real before = 0;
    for (int j = 0; j < COMMANDS; j++) {
        const real now = j < COMMANDS - 1 ? response(PERIOD * (real)(j + 1) - wait, larger(lag, NO_LAG), span) : 1;
        h[j] = now - before, before = now;
    }
}

/* falls: exp(-PERIOD / lag). */
static void lead_in(head *to, real total, real lag, real span, real falls) {
    const real wait = larger(total - lag, 0), whole = floor(wait / PERIOD), first = (whole + 1) * PERIOD - wait;
    real before = 0, sum_before = 0, left = exp(-first / larger(lag, NO_LAG));
    to->first = (int)whole, lag = larger(lag, NO_LAG);
    for (int k = 0; k < 3; k++, left *= falls) {
        const real x = first + PERIOD * (real)k, sum = x + lag * (left - 1);
        real now = 1 - left;
        if (span > INSTANT) now = (sum - (span == PERIOD ? sum_before : integral(x - span, lag))) / span;
        to->h[k] = now - before, before = now, sum_before = sum;
    }
}

/* Sums with the tail g of a lag that begins at each j, g_i = falls^(i - j), the last for all behind it: g'y, g'M g, and
   (M g)_i for the two i before j; M: y, y before, phi, 1 to a side. */
static void tail_sums(real (*restrict sums)[4], const real *restrict M, real falls) {
    real behind[BLOCK];
    for (int j = COMMANDS - 1; j >= 0; j--) {
        const real *restrict column = M + BLOCK * (j + 2);
        const int last = j == COMMANDS - 1;
        const real before = last ? 0 : behind[j + 2], square = last ? 0 : sums[j + 1][1];
        const real all = 1 / (1 - falls);
        sums[j][1] = last ? column[j + 2] * all * all : column[j + 2] + 2 * falls * before + falls * falls * square;
        for (int i = 0; i < j + 2; i++) behind[i] = last ? column[i] * all : column[i] + falls * behind[i];
        sums[j][0] = behind[0];
        for (int i = 0; i < 2; i++) sums[j][2 + i] = j + i >= 2 ? behind[j + i] : 0;
    }
}

static real information(real product, real square) {
    const real rho = product / larger(square, FLOOR * FLOOR);
    return smaller(larger((1 - rho) / (1 + rho), LEAST_INFORMATION), MOST_INFORMATION);
}

/* posterior.py: _by_commands. Leaves the mean squared innovation of each hypothesis, and what the logarithm of one is
   worth; returns the largest log likelihood. */
static real by_commands(
    real *restrict sse, real *worth, const head *heads, const real *M, const channel *c, const grid *g) {
    const int count = c->count, all = count * g->size[L];
    real cross[MOST], square[MOST], sums[COMMANDS][4], least = NEVER, lowest = NEVER, scale = 0;
    int best = 0;
    for (int l = 0; l < g->size[L]; l++) {
        if (!inside(g, L, l)) continue;
        tail_sums(sums, M, exp(-PERIOD / larger(at(g, L, l), NO_LAG)));
        for (int k = count * l; k < count * (l + 1); k++) {
            if (!heads[k].possible) continue;
            const int f = heads[k].first;
            const real *h = heads[k].h, *of = sums[f + 2], *row = M + (BLOCK + 1) * (f + 2);
            cross[k] = h[0] * M[BLOCK * (f + 2)] + h[1] * M[BLOCK * (f + 3)] + h[2] * of[0];
            square[k] = h[2] * (h[2] * of[1] + 2 * (h[0] * of[2] + h[1] * of[3]));
            square[k] += h[0] * (h[0] * row[0] + 2 * h[1] * row[BLOCK]) + h[1] * h[1] * row[BLOCK + 1];
            least = smaller(least, M[0] - 2 * cross[k] + square[k]);
        }
    }
    const real ridge = larger(least, 0) / c->numbers / (c->deviation * c->deviation) + FLOOR;
    for (int k = 0; k < all; k++) {
        if (!heads[k].possible) continue;
        const real s = (cross[k] + ridge) / (square[k] + ridge);
        sse[k] = larger(M[0] - 2 * s * cross[k] + s * s * square[k], 0);
        if (sse[k] < lowest) lowest = sse[k], best = k, scale = s;
    }
    real h[BLOCK] = {1, 0}, now = 0, before = 0, of[BLOCK];
    command_weights(h + 2, c->low + c->step * (real)(best % count) + c->shift, at(g, L, best / count), c->span);
    for (int i = 2; i < BLOCK; i++) h[i] *= -scale;
    for (int i = 0; i < BLOCK; i++) {
        const real *restrict row = M + BLOCK * i;
        real all = h[i] * row[i];
        for (int j = 0; j < i; j++) all += h[j] * row[j], of[j] += h[i] * row[j];
        of[i] = all;
    }
    for (int i = 0; i < BLOCK; i++) now += h[i] * of[i];
    for (int i = 1; i < BLOCK; i++) before += h[i - 1] * of[i];
    *worth = information(before, now) * c->numbers / 2;
    for (int k = 0; k < all; k++)
        if (heads[k].possible) sse[k] = sse[k] / c->numbers + FLOOR;
    return -*worth * log(lowest / c->numbers + FLOOR);
}

static void logarithms(real *restrict log_p, const head *heads, real worth, int all) {
    for (int k = 0; k < all; k++) log_p[k] = heads[k].possible ? -worth * log(log_p[k]) : -NEVER;
}

static real gain_of(real ratio) {
    const real squared = ratio * ratio, variance = squared / 2 + sqrt(squared * squared / 4 + squared);
    return variance / (variance + 1);
}

/* posterior.py: _by_readings */
static void by_readings(
    real *log_p, const real *M, const grid *g, int of, real span, real numbers, real prior, real reading, real noise) {
    const real kept = 1 - gain_of(reading / noise), white = reading * reading / (1 - kept * kept);
    real sse[SIDE], cross[SIDE][BIAS], added[SIDE], weights[SIDE][1 + MEANS], least = NEVER, lowest = NEVER;
    int places[SIDE][1 + MEANS], best = 0;
    for (int k = 0; k < g->size[of]; k++) {
        if (!inside(g, of, k)) continue;
        const real old = (at(g, of, k) - span / 2) / PERIOD, whole = larger(floor(old + INSTANT), 0), part = old - whole;
        const real means[] = {1, (1 - part) * (1 - part) / -2, part * part - part - (real)0.5, part * part / -2};
        sse[k] = added[k] = 0;
        for (int i = 0; i <= MEANS; i++) weights[k][i] = means[i], places[k][i] = i ? (int)whole + i : 0;
        for (int b = 0; b < BIAS; b++) cross[k][b] = 0;
        for (int i = 0; i <= MEANS; i++) {
            const real *row = M + 2 * COLUMNS * places[k][i];
            for (int j = 0; j <= i; j++) sse[k] += (j < i ? 2 : 1) * means[i] * means[j] * row[places[k][j]];
            for (int b = 0; b < BIAS; b++) cross[k][b] += means[i] * M[2 * COLUMNS * (1 + READINGS + b) + places[k][i]];
            for (int j = 1; i && j <= MEANS; j++)
                added[k] += means[i] * means[j] * (i == j ? 1 : i - j == 2 || j - i == 2 ? kept * kept : kept);
        }
        added[k] *= white;
        least = smaller(least, sse[k]);
    }
    const real *S = M + (2 * COLUMNS + 1) * (1 + READINGS), ridge = larger(least, 0) / numbers / (prior * prior) + FLOOR;
    real S_of[BIAS][BIAS], inverse[BIAS][BIAS], estimate[SIDE][BIAS];
    for (int i = 0; i < BIAS; i++)
        for (int j = 0; j <= i; j++) S_of[i][j] = S_of[j][i] = S[2 * COLUMNS * i + j] + (i == j ? ridge : 0);
    real determinant = 0;
    for (int i = 0; i < BIAS; i++)
        for (int j = 0; j < BIAS; j++) {
            const int a = (j + 1) % 3, b = (j + 2) % 3, c = (i + 1) % 3, d = (i + 2) % 3;
            inverse[i][j] = S_of[a][c] * S_of[b][d] - S_of[a][d] * S_of[b][c];
        }
    for (int j = 0; j < BIAS; j++) determinant += S_of[0][j] * inverse[j][0];
    for (int k = 0; k < g->size[of]; k++) {
        if (!inside(g, of, k)) continue;
        for (int i = 0; i < BIAS; i++) {
            estimate[k][i] = 0;
            for (int j = 0; j < BIAS; j++) estimate[k][i] += inverse[i][j] * cross[k][j] / determinant;
            sse[k] -= cross[k][i] * estimate[k][i];
        }
        sse[k] = larger(sse[k], 0);
        if (sse[k] < lowest) lowest = sse[k], best = k;
    }
    const real rest = larger(lowest / numbers - added[best], 0) + FLOOR, first = added[0] + rest;
    lowest = NEVER;
    for (int k = 0; k < g->size[of]; k++) {
        if (!inside(g, of, k)) continue;
        sse[k] *= first / (added[k] + rest);
        if (sse[k] < lowest) lowest = sse[k], best = k;
    }
    real h[COLUMNS] = {0}, square = 0, product = 0;
    for (int i = 0; i <= MEANS; i++) h[places[best][i]] = weights[best][i];
    for (int i = 0; i < BIAS; i++) h[1 + READINGS + i] = -estimate[best][i];
    for (int i = 0; i < COLUMNS; i++) {
        const real *row = M + 2 * COLUMNS * i, *before = row + 2 * COLUMNS * COLUMNS;
        for (int j = 0; j <= i; j++) square += (j < i ? 2 : 1) * h[i] * h[j] * row[j];
        for (int j = 0; j < COLUMNS; j++) product += h[i] * h[j] * before[j];
    }
    const real worth = information(product, square) * numbers / 2;
    for (int k = 0; k < g->size[of]; k++)
        log_p[k] = inside(g, of, k) ? -worth * log(sse[k] / numbers + FLOOR) : -NEVER;
}

static int likelier(real *best, const real *other, int size, int first) {
    real most = -NEVER, most_of_other = -NEVER;
    for (int i = 0; i < size; i++) most = larger(most, best[i]), most_of_other = larger(most_of_other, other[i]);
    if (!first && !(most_of_other > most)) return 0;
    for (int i = 0; i < size; i++) best[i] = other[i];
    return 1;
}

static int rates_of(real age, real newer) {
    return newer < INSTANT ? LATE : fabs(age - newer) < INSTANT ? PROMPT : BETWEEN;
}

static void summary(number **res, int of, const real *share, const grid *g, real beside) {
    const real step = g->step[of], begins = g->low[of] - step / 2;
    real all = 0, mean = 0, spread = 0, below = 0, low = begins, high = begins;
    for (int i = 0; i < g->size[of]; i++) all += share[i], mean += share[i] * at(g, of, i);
    mean /= all;
    for (int i = 0; i < g->size[of]; i++) {
        const real here = share[i] / all, off = at(g, of, i) - mean, least = larger(here, 1 / NEVER);
        spread += here * off * off;
        low += step * smaller(larger(((real)0.025 - below) / least, 0), 1);
        high += step * smaller(larger(((real)0.975 - below) / least, 0), 1);
        below += here;
    }
    res[MEAN][of] = mean, res[DEVIATION][of] = sqrt(spread + step * step / 12);
    res[LOWER][of] = larger(low - beside / 2, 0), res[UPPER][of] = high + beside / 2;
}

static const real NOISES[] = VELOCITY_NOISES, AGAINST[] = RATES_ODDS;
static const real STEPS[] = {AGE_STEP, TOTAL_STEP, LAG_STEP, AGE_STEP}, LARGEST[] = {LARGEST_AGE, (LARGEST_DEAD_TIME + LARGEST_LAG), LARGEST_LAG, LARGEST_AGE};

static void posterior(const number **arg, const number *centre, number **res, int fine) {
    const int whole = fine == 1;
    grid g;
    for (int i = 0; i < 4; i++) {
        const real reach = whole ? LARGEST[i] : STEPS[i];
        g.step[i] = STEPS[i] / (real)fine, g.size[i] = (int)floor((whole ? reach : 2 * reach) / g.step[i] + (real)1.5);
        g.low[i] = larger(centre[i] - reach, 0), g.high[i] = smaller(centre[i] + reach, LARGEST[i]);
    }
    const int n_a = g.size[A], n_D = g.size[D], n_l = g.size[L], n_r = g.size[R], olds = whole ? n_a : n_a + n_r - 1;
    const int times = olds + n_D - 1;
    const real first = larger(g.low[A] - g.high[R], 0), latest = larger(g.high[A] - g.low[R], 0) + g.high[D];

    /* thrusts, of total and lag; gyroscope, of lag and the total beside what rates are old by */
    head heads[MOST];
    real of_total[MOST], of_gyro[MOST], other[MOST];
    const real seen = larger(arg[WEIGHTS][0], 1);
    real falls[SIDE];
    for (int l = 0; l < n_l; l++) falls[l] = exp(-PERIOD / larger(at(&g, L, l), NO_LAG));
    const channel thrust = {g.low[D], g.step[D], 0, SPAN_FORCE, SCALE_DEVIATION, seen, n_D};
    for (int l = 0; l < n_l; l++)
        for (int k = 0; k < n_D; k++) {
            const real total = at(&g, D, k), lag = at(&g, L, l), dead_time = total - lag;
            head *one = heads + n_D * l + k;
            one->possible = inside(&g, D, k) && inside(&g, L, l);
            one->possible &= dead_time > -INSTANT && dead_time < LARGEST_DEAD_TIME + INSTANT;
            if (one->possible) lead_in(one, total, lag, SPAN_FORCE, falls[l]);
        }
    real worth, most_of_gyro = 0;
    (void)by_commands(of_total, &worth, heads, moments(arg[THRUST]), &thrust, &g);
    logarithms(of_total, heads, worth, n_D * n_l);
    for (int k = 0; k < n_D; k++) {
        const real total = at(&g, D, k), ways = smaller(total, LARGEST_LAG) - larger(total - LARGEST_DEAD_TIME, 0);
        const real prior = -total / MEAN_DELAY - log(larger(ways, 0) + LAG_STEP);
        for (int l = 0; l < n_l; l++)
            if (heads[n_D * l + k].possible) of_total[n_D * l + k] += prior;
    }
    const channel gyro = {first + g.low[D], g.step[A], SPAN_RATE / 2, PERIOD, INERTIA_DEVIATION, 2 * seen, times};
    for (int l = 0; l < n_l; l++)
        for (int k = 0; k < times; k++) {
            const real time = gyro.low + gyro.step * (real)k;
            head *one = heads + times * l + k;
            const real wait = time - at(&g, L, l);
            one->possible = time < latest + INSTANT && inside(&g, L, l);
            one->possible &= wait > -INSTANT && wait < LARGEST_DEAD_TIME + LARGEST_AGE + INSTANT;
            if (one->possible) lead_in(one, time + gyro.shift, at(&g, L, l), PERIOD, falls[l]);
        }
    int models[2] = {0, 0};
    for (int i = whole ? 0 : (int)arg[MODELS][0], begins = 1; i < GYROS; i++, begins = 0) {
        real of_other;
        const real found = by_commands(other, &of_other, heads, moments(arg[GYRO]) + BLOCK * BLOCK * i, &gyro, &g);
        if (begins || found > most_of_gyro) {
            models[0] = i, most_of_gyro = found, worth = of_other;
            for (int k = 0; k < times * n_l; k++) of_gyro[k] = other[k];
        }
        if (!whole) break;
    }
    logarithms(of_gyro, heads, worth, times * n_l);
    real most[SIDES], without[SIDES], all[SIDES], by_total[SIDES][SIDE], by_lag[SIDES][SIDE];
    for (int i = 0; i < olds; i++) {
        most[i] = without[i] = -2 * NEVER;
        for (int l = 0; l < n_l; l++) {
            const real *a = of_total + n_D * l, *b = of_gyro + times * l + i;
            for (int k = 0; k < n_D; k++) most[i] = larger(most[i], a[k] + b[k]);
            without[i] = larger(without[i], a[0] + b[0]);
        }
    }

    /* velocities and attitudes, of age and of what rates are newer by */
    const real reading = PERIOD * sqrt(arg[LATERAL][0]);
    real of_age[SIDE], of_newer[SIDE], p[SIDE][SIDE];
    for (int i = whole ? 0 : (int)arg[MODELS][1], begins = 1; i < VELOCITIES; i++, begins = 0) {
        const real *M = moments(arg[VELOCITY]) + 4 * COLUMNS * COLUMNS * i;
        by_readings(
            other, M, &g, A, SPAN_FORCE, 2 * larger(arg[WEIGHTS][1], 1), BIAS_DEVIATION, reading, NOISES[i]);
        if (likelier(of_age, other, n_a, begins)) models[1] = i;
        if (!whole) break;
    }
    by_readings(
        of_newer, moments(arg[ATTITUDE]), &g, R, SPAN_RATE, 3 * larger(arg[WEIGHTS][2], 1), RATE_BIAS_DEVIATION,
        TURN_NOISE, ATTITUDE_NOISE);
    real best = -2 * NEVER, ageless = -NEVER, prompt = -NEVER;
    int a_best = 0, r_best = 0, old_of[SIDE][SIDE];
    for (int r = 0; r < n_r; r++)
        for (int a = 0; a < n_a; a++) {
            const real age = at(&g, A, a), by = at(&g, R, r);
            const int rates = rates_of(age, by), old = (int)floor((larger(age - by, 0) - first) / g.step[A] + (real)0.5);
            int counts = inside(&g, A, a) && inside(&g, R, r) && age - by > -INSTANT;
            counts &= rates != BETWEEN || by > AGE_STEP - INSTANT; /* less is how rates go between readings */
            p[r][a] = -NEVER, old_of[r][a] = old < 0 ? 0 : old < olds ? old : olds - 1;
            if (counts) {
                const real alone = of_age[a] - age / MEAN_DELAY + of_newer[r] - AGAINST[rates];
                p[r][a] = alone + most[old_of[r][a]];
                prompt = larger(prompt, alone + without[old_of[r][a]]);
                if (!a) ageless = larger(ageless, p[r][a]);
            }
            if (p[r][a] > best) best = p[r][a], a_best = a, r_best = r;
        }
    const int i_best = old_of[r_best][a_best];
    int k_best = 0; /* the first of these */
    for (int k = n_D * n_l - 1; k >= 0; k--)
        if (of_total[k] + of_gyro[times * (k / n_D) + k % n_D + i_best] >= most[i_best]) k_best = k;
    const int place[] = {a_best, k_best % n_D, k_best / n_D, r_best};
    for (int i = 0; i < 4; i++) res[MODE][i] = at(&g, i, place[i]);
    for (int i = 0; i < 3; i++) res[AT_END][i] = res[MODE][i] > LARGEST[i] - INSTANT;
    res[AT_END][3] = res[MODE][D] - res[MODE][L] > LARGEST_DEAD_TIME - INSTANT;
    res[CHOSEN][0] = (real)models[0], res[CHOSEN][1] = (real)models[1];
    res[ODDS][0] = best - ageless, res[ODDS][1] = best - prompt;
    *res[MOVED] = 0;
    if (whole) return;
    for (int i = 0; i < 4; i++)
        if (fabs(res[MODE][i] - centre[i]) >= STEPS[i] - INSTANT) *res[MOVED] = 1;

    real of_each[SIDES] = {0}, shares[3][SIDE] = {{0}};
    for (int i = 0; i < olds; i++) all[i] = -1;
    for (int r = 0; r < n_r; r++)
        for (int a = 0; a < n_a; a++) {
            const int i = old_of[r][a];
            const real likely = exp(p[r][a] - best);
            if (!(likely > 1 / NEVER)) continue;
            if (all[i] < 0) { /* of an age that is likely, once */
                all[i] = 0;
                for (int k = 0; k < SIDE; k++) by_total[i][k] = by_lag[i][k] = 0;
                for (int l = 0; l < n_l; l++)
                    for (int k = 0; k < n_D; k++) {
                        const real share = exp(of_total[n_D * l + k] + of_gyro[times * l + k + i] - most[i]);
                        all[i] += share, by_total[i][k] += share, by_lag[i][l] += share;
                    }
            }
            shares[A][a] += likely * all[i], of_each[i] += likely;
        }
    for (int i = 0; i < olds; i++) {
        if (all[i] < 0) continue;
        for (int k = 0; k < n_D; k++) shares[D][k] += of_each[i] * by_total[i][k];
        for (int k = 0; k < n_l; k++) shares[L][k] += of_each[i] * by_lag[i][k];
    }
    const real beside[] = {AGE_STEP / (real)fine, LAG_STEP / (real)fine, LAG_STEP / (real)fine};
    for (int i = 0; i < 3; i++) summary(res, i, shares[i], &g, beside[i]);
    *res[NEWER] = rates_of(res[MODE][A], res[MODE][R]) == PROMPT ? res[MEAN][A] : res[MODE][R];
}

int coarse(const number **arg, number **res, integer *iw, number *w, int memory) {
    (void)iw, (void)w, (void)memory;
    posterior(arg, arg[CENTRE], res, 1);
    return 0;
}

int fine(const number **arg, number **res, integer *iw, number *w, int memory) {
    (void)iw, (void)w, (void)memory;
    number centre[4];
    for (int i = 0; i < 4; i++) centre[i] = arg[CENTRE][i];
    for (int k = 0; k == 0 || (k < *arg[ROUNDS] && *res[MOVED]); k++) {
        if (k)
            for (int i = 0; i < 4; i++) centre[i] = res[MODE][i];
        posterior(arg, centre, res, FINE);
    }
    return 0;
}
