/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* Derivatives, outputs and the integrator of co-simulation. */
static int rates(Model *m)
{
    int status = 0;
    if (m->rates == 0) {
        status = prepare(m);
        memcpy(m->v + DQ, m->v + QD, N * sizeof(double));
        if (status == 0) {
            status = accelerate(m, m->v + Q, m->v + DQD, m->v + INDICATORS);
        }
        m->rates = (status == 0) ? 1 : 0;
    }
    return status;
}

static int results(Model *m)
{
    int status = 0;
    if (m->results == 0) {
        status = prepare(m);
        if (status == 0) {
            status = @_forward_with(m->parameters, m->v + Q, m->v + POSE);
        }
        if (status == 0) {
            status = rates(m);
        }
        m->v[STATUS] = (double)status;
        m->results = (status == 0) ? 1 : 0;
    }
    return status;
}

/* One step of the classical Runge-Kutta method of order four, from x to y. */
static int step(const Model *m, const double *x, double span, double *y)
{
    static const double at[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0, 2.0, 2.0, 1.0};
    double k[2 * N], z[ANY(DRY)];
    int part, i;
    memset(k, 0, sizeof k);
    memcpy(y, x, sizeof k);
    for (part = 0; part < 4; part++) {
        double here[2 * N];
        int status;
        for (i = 0; i < (2 * N); i++) {
            here[i] = x[i] + (at[part] * span * k[i]);
        }
        memcpy(k, here + N, N * sizeof *k);
        status = accelerate(m, here, k + N, z);
        if (status != 0) {
            return status;
        }
        for (i = 0; i < (2 * N); i++) {
            y[i] += span * weight[part] * k[i] / 6.0;
        }
    }
    return 0;
}

#if DRY > 0
/* Whether a mode has ended at x. */
static int ended(const Model *m, const double *x, int *status)
{
    double a[N], z[DRY];
    int i;
    *status = accelerate(m, x, a, z);
    for (i = 0; (*status == 0) && (i < DRY); i++) {
        if (z[i] <= 0.0) {
            return 1;
        }
    }
    return 0;
}
#endif

/* One internal step; where a mode ends in it, its time is bisected and the rest is a new step. */
static int part(Model *m, double span)
{
    double y[2 * N];
#if DRY > 0
    double left = span;
    int changes, status, changed;
    for (changes = 0; changes <= CHANGES; changes++) {
        double low = 0.0, high = left;
        status = step(m, m->v + Q, left, y);
        if (status != 0) {
            return status;
        }
        if (ended(m, y, &status) == 0) {
            memcpy(m->v + Q, y, sizeof y);
            return status;
        }
        while ((changes < CHANGES) && ((high - low) > (INSTANT * span))) {
            const double middle = 0.5 * (low + high);
            status = step(m, m->v + Q, middle, y);
            if (status != 0) {
                return status;
            }
            if (ended(m, y, &status) != 0) {
                high = middle;
            } else {
                low = middle;
            }
        }
        status = step(m, m->v + Q, high, y);
        memcpy(m->v + Q, y, sizeof y);
        if (status == 0) {
            status = event(m, &changed);
        }
        left -= high;
        if ((status != 0) || (left <= 0.0)) {
            return status;
        }
    }
    return 0;
#else
    const int status = step(m, m->v + Q, span, y);
    memcpy(m->v + Q, y, sizeof y);
    return status;
#endif
}

static int advance(Model *m, double span)
{
    const double count = ceil((span / m->v[STEP]) - 1e-9);
    double k;
    int changed;
    int status = event(m, &changed);
    if (!((m->v[STEP] > 0.0) && (count < 1e9))) {
        return 2;
    }
    for (k = 0.0; (k < count) && (status == 0); k += 1.0) {
        status = part(m, span / count);
    }
    touch(m);
    return (status != 0) ? status : results(m);
}
