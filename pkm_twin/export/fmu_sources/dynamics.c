/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* An FMU of forward dynamics: terms of the equations of motion. */
/* M a + bias = tau - friction + twists' wrench; rows: rates of passive joints by joint rates. */
#define BIAS (N * N)
#define TWISTS (BIAS + N + 2)
#define ROWS (TWISTS + 6 * N)
#define DRIFT (ROWS + PASSIVE * N)
#define TERMS (DRIFT + PASSIVE)

/* The lower triangle of a symmetric matrix becomes its Cholesky factor; 0 if it is not positive. */
static int cholesky(double *a, int n, double least)
{
    int i, j, k;
    for (j = 0; j < n; j++) {
        double pivot = a[(j * n) + j];
        for (k = 0; k < j; k++) {
            pivot -= a[(j * n) + k] * a[(j * n) + k];
        }
        if (!(pivot > (least * a[(j * n) + j]))) {
            return 0;
        }
        pivot = sqrt(pivot);
        a[(j * n) + j] = pivot;
        for (i = j + 1; i < n; i++) {
            double sum = a[(i * n) + j];
            for (k = 0; k < j; k++) {
                sum -= a[(i * n) + k] * a[(j * n) + k];
            }
            a[(i * n) + j] = sum / pivot;
        }
    }
    return 1;
}

static void solve(const double *l, int n, double *b)
{
    int i, k;
    for (i = 0; i < n; i++) {
        for (k = 0; k < i; k++) {
            b[i] -= l[(i * n) + k] * b[k];
        }
        b[i] /= l[(i * n) + i];
    }
    for (i = n - 1; i >= 0; i--) {
        for (k = i + 1; k < n; k++) {
            b[i] -= l[(k * n) + i] * b[k];
        }
        b[i] /= l[(i * n) + i];
    }
}

/* Terms t and the factor l of the mass matrix at x: positions, then rates. */
static int terms(const Model *m, const double *x, double *t, double *l)
{
    const int status = @_terms_with(m->parameters, x, x + N, t);
    if (status != 0) {
        return status;
    }
    memcpy(l, t, N * N * sizeof *l);
    return (cholesky(l, N, LEAST) != 0) ? 0 : 1;
}

/* Generalised forces but inertia and dry friction. */
static void forces(const Model *m, const double *x, const double *t, double *rest)
{
    int i, k;
    for (i = 0; i < N; i++) {
        rest[i] = m->v[TAU + i] - OFFSET[i] - (VISCOUS[i] * x[N + i]) - t[BIAS + i];
        for (k = 0; k < 6; k++) {
            rest[i] += t[TWISTS + (k * N) + i] * m->v[WRENCH + k];
        }
    }
#if PASSIVE > 0
    for (k = 0; k < PASSIVE; k++) {
        const double *row = t + ROWS + (k * N);
        double rate = 0.0;
        for (i = 0; i < N; i++) {
            rate += row[i] * x[N + i];
        }
        for (i = 0; i < N; i++) {
            rest[i] -= PASSIVE_VISCOUS[k] * rate * row[i];
        }
    }
#endif
}
