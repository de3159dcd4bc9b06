/* The two-mass loop of the paper's simulation study in plain C: plant, model-free ESO of order 4,
 * control law, and the lag-compensated Kalman learner with state and bias features. All sizes are
 * compile-time constants, all arrays are static or on the stack, as in a careful implementation by
 * hand. c_reference.py builds it with gcc -O3 -march=native and passes the design (Phi, L, the taps
 * of the lag filter), so that the trajectory can be compared with that of quell. With -DPLAIN it is the
 * loop without learner, whose rows end with the status.
 *
 * Each row of the log holds r, y, measured y, u, w1, w2, x (4), x-hat (4), residual f, learned f, status, theta (5): 22 numbers. */
#include <math.h>
#include <stddef.h>

#define NX 4
#define N (NX + 1)
#define P (NX + 1)
#define M (P + 1)
#ifdef PLAIN
#define ROW 17
#else
#define ROW 22
#endif

typedef struct {
    double dt;
    double plant_A[NX][NX], plant_B[NX], plant_E[NX][2], plant_C[NX];
    double phi[N][N], gamma_u[N], gamma_f[N], gain[N];
    double law[NX], b0;
    double pole, rise, taps[N];
    double scale[NX], threshold[P], walk_bias, forget, lag_time, prior, fastest, f_noise;
} design_t;

typedef struct {
    double x[NX], z[N], u, f_learned;
    int started;
    double theta[P], cov[P][P], chain[M][N], filtered[M], mean[NX], variance[NX], noise, unexplained, filled, since;
} state_t;

static inline double step(const design_t *restrict d, state_t *restrict s, double r, double y)
{
    if (!s->started) {
        for (int i = 0; i < N; i++) s->z[i] = 0.0;
        s->z[0] = y;
        s->started = 1;
    } else {
        double pred[N];
        for (int i = 0; i < N; i++) {
            double sum = d->gamma_u[i] * s->u + d->gamma_f[i] * s->f_learned;
            for (int j = 0; j < N; j++) sum += d->phi[i][j] * s->z[j];
            pred[i] = sum;
        }
        double error = y - pred[0];
        for (int i = 0; i < N; i++) s->z[i] = pred[i] + d->gain[i] * error;

#ifndef PLAIN
        double target = s->z[N - 1] + s->filtered[P], innovation = target, deviation = y - s->z[0], rounding = 1e-8 * y;
        for (int i = 0; i < P; i++) innovation -= s->theta[i] * s->filtered[i];
        double doubt = 0.1 * target;
        s->noise += d->forget * (deviation * deviation + rounding * rounding - s->noise);
        s->unexplained += d->forget * (innovation * innovation + doubt * doubt - s->unexplained);
        s->filled += d->forget * (1.0 - s->filled);
        s->since += d->dt;
        double noise = s->noise / s->filled, root = sqrt(d->lag_time * (s->unexplained + d->f_noise * s->noise) / s->filled);
        if (root != 0.0) {
            double weight = 1.0 / root, taught[P], g[P], spread = 0.0;
            for (int i = 0; i < NX; i++) {
                double away = s->filtered[i] - s->mean[i];
                s->mean[i] += d->forget * away;
                s->variance[i] += d->forget * (away * away - s->variance[i]);
                taught[i] = s->variance[i] > d->threshold[i] * noise ? (s->filtered[i] - s->mean[i]) * weight : 0.0;
            }
            taught[P - 1] = s->filtered[P - 1];
            if (s->since > 2.0 * d->lag_time) {
                for (int i = 0; i < P; i++) {
                    double sum = 0.0;
                    for (int j = 0; j < P; j++) sum += s->cov[i][j] * taught[j];
                    g[i] = sum;
                    spread += sum * taught[i];
                }
                double per = 1.0 / fmax(spread + 1.0 / d->dt, spread / (d->fastest * d->dt));
                for (int i = 0; i < P; i++) {
                    double share = g[i] * per;
                    double change = share * innovation * (i < NX ? weight : 1.0);
                    s->theta[i] += change;
                    if (i < NX) s->theta[P - 1] -= change * s->mean[i];
                    for (int j = 0; j < P; j++) s->cov[i][j] -= share * g[j];
                }
                s->cov[P - 1][P - 1] += d->walk_bias * d->dt;
            }
        }
#endif
    }
    double f = 0.0, u0 = d->law[0] * r;
    for (int i = 0; i < NX; i++) u0 -= d->law[i] * s->z[i];
#ifndef PLAIN
    f = s->theta[P - 1];
    for (int i = 0; i < NX; i++) f += s->theta[i] * d->scale[i] * s->z[i];
#endif
    double u = (u0 - f - s->z[N - 1]) / d->b0;
    s->u = u;
    s->f_learned = f;

#ifndef PLAIN
    for (int i = 0; i < M; i++) {
        double input = i < NX ? d->scale[i] * s->z[i] : i < P ? 1.0 : f;
        double carry = d->rise * input, sum = 0.0;
        for (int j = 0; j < N; j++) {
            double old = s->chain[i][j];
            double new = d->pole * old + carry;
            carry = d->rise * old;
            s->chain[i][j] = new;
            sum += d->taps[j] * new;
        }
        s->filtered[i] = sum;
    }
#endif
    return u;
}

static void rest(state_t *s)
{
    s->started = 0;
    s->u = s->f_learned = s->since = 0.0;
    for (int i = 0; i < NX; i++) s->x[i] = 0.0;
    for (int i = 0; i < M; i++) {
        s->filtered[i] = 0.0;
        for (int j = 0; j < N; j++) s->chain[i][j] = 0.0;
    }
}

/* The paper's scenario: sin t until rest_at, then from rest a unit step; sin(0.1 pi (t - 150)) on m2 from 150 s.
 * noise[i] is held for `hold` samples. Returns the last output. */
double run(const design_t *design, size_t samples, double rest_at, const double *noise, size_t hold, double *log)
{
    const design_t d = *design;
    state_t s = {0};
    for (int i = 0; i < NX; i++) s.cov[i][i] = d.prior * d.prior;
    const size_t at_rest = (size_t)lround(rest_at / d.dt), from = (size_t)lround(150.0 / d.dt);
    double y = 0.0;
    for (size_t k = 0; k < samples; k++) {
        if (k == at_rest) rest(&s);
        double t = (double)k * d.dt;
        double r = k < at_rest ? sin(t) : 1.0;
        double w2 = k < from ? 0.0 : sin(0.1 * M_PI * (t - 150.0));
        y = 0.0;
        for (int i = 0; i < NX; i++) y += d.plant_C[i] * s.x[i];
        double measured = y + noise[k / hold];
        double u = step(&d, &s, r, measured);
        if (log) {
            double *row = log + k * ROW;
            row[0] = r, row[1] = y, row[2] = measured, row[3] = u, row[4] = 0.0, row[5] = w2;
            for (int i = 0; i < NX; i++) row[6 + i] = s.x[i], row[10 + i] = s.z[i];
            row[14] = s.z[N - 1], row[15] = s.f_learned, row[16] = 0.0;
#ifndef PLAIN
            for (int i = 0; i < P; i++) row[17 + i] = s.theta[i] * (i < NX ? d.scale[i] : 1.0);
#endif
        }
        double next[NX];
        for (int i = 0; i < NX; i++) {
            double sum = d.plant_B[i] * u + d.plant_E[i][0] * 0.0 + d.plant_E[i][1] * w2;
            for (int j = 0; j < NX; j++) sum += d.plant_A[i][j] * s.x[j];
            next[i] = sum;
        }
        for (int i = 0; i < NX; i++) s.x[i] = next[i];
    }
    return y;
}
