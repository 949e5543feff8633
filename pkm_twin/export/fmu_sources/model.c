/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* Variables of an FMU and its payload; @ stands for the exported C's prefix. */
/* What a state of the FMU is: all variables by value reference, and what follows from events. */
typedef enum { CREATED, INITIALISING, RUNNING, ENDED } Phase;

typedef struct {
    double v[COUNT];
    double parameters[PARAMETERS];
    double pull[ANY(DRY)];   /* dry friction of a row that does not hold by itself */
    double slack[ANY(DRY)];  /* what a force may exceed its bound by */
    int mode[ANY(DRY)];
    int sign[ANY(DRY)];
    int prepared;
    int rates;    /* derivatives and event indicators are those of the state */
    int results;  /* so are the outputs */
    Phase phase;
} Model;

static void begin(Model *m)
{
    memset(m, 0, sizeof *m);
    memcpy(m->v, START, sizeof m->v);
}

/* Something was set. */
static void touch(Model *m)
{
    m->rates = 0;
    m->results = 0;
}

/* Parameters of the payload; status as of the exported functions. */
static int prepare(Model *m)
{
    if (m->prepared == 0) {
        const double *load = m->v + PAYLOAD;
        const double xx = load[4], yy = load[5], zz = load[6], xy = load[7], xz = load[8];
        const double yz = load[9];
        double inertia[9];
        inertia[0] = xx;
        inertia[1] = inertia[3] = xy;
        inertia[2] = inertia[6] = xz;
        inertia[4] = yy;
        inertia[5] = inertia[7] = yz;
        inertia[8] = zz;
        if (@_parameters(load[0], load + 1, inertia, m->parameters) != 0) {
            return 2;
        }
        m->prepared = 1;
    }
    return 0;
}
