/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* What both versions of FMI ask for; the types are those of the standard's headers. */
#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif
#define JOIN(a, b) a##b
#define JOINED(a, b) JOIN(a, b)

typedef unsigned int Reference;
typedef enum { STATUS_OK, STATUS_WARNING, STATUS_DISCARD, STATUS_ERROR, STATUS_FATAL } Status;

LOGGER
typedef struct {
    Model model;
    char name[128];
    Logger log;
    void *environment;
} Instance;

/* Size of a state that is written out, with its hash. */
#define SAVED (sizeof(Model) + sizeof(unsigned int))

static Status complain(const Instance *c, Status status, const char *what)
{
    static const char *const category[] = {
        "", "logStatusWarning", "logStatusDiscard", "logStatusError", "logStatusFatal"};
    if (c->log != NULL) {
        CALL_LOGGER;
    }
    return status;
}

/* Of a status of the exported functions. */
static Status said(const Instance *c, int status)
{
    if (status == 0) {
        return STATUS_OK;
    }
    if (status == 1) {
        return complain(c, STATUS_DISCARD,
            "no assembly for these joint positions, or a singularity on the way to them");
    }
    return complain(c, STATUS_ERROR,
        "an input, state or parameter is NaN, infinite or out of range, or a result is infinite");
}

static Instance *instantiate(const char *name, const char *token, Logger log, void *environment)
{
    Instance *c = (Instance *)calloc(1, sizeof *c);
    if (c == NULL) {
        return NULL;
    }
    c->log = log;
    c->environment = environment;
    if (name != NULL) {
        strncpy(c->name, name, sizeof c->name - 1);
    }
    if ((token == NULL) || (strcmp(token, TOKEN) != 0)) {
        (void)complain(c, STATUS_ERROR, "the token is not that of these sources");
        free(c);
        return NULL;
    }
    begin(&c->model);
    return c;
}

static Status get_reals(Instance *c, const Reference *vr, size_t count, double *values)
{
    size_t i;
    for (i = 0; i < count; i++) {
        Status status = STATUS_OK;
        if ((vr[i] >= COUNT) || (vr[i] == STATUS_AT)) {
            return complain(c, STATUS_ERROR, "no variable of this type has this value reference");
        }
        if (KIND[vr[i]] == 'o') {
            status = said(c, results(&c->model));
        } else if (KIND[vr[i]] == 'd') {
            status = said(c, rates(&c->model));
        }
        if (status != STATUS_OK) {
            return status;
        }
        values[i] = c->model.v[vr[i]];
    }
    return STATUS_OK;
}

static Status set_reals(Instance *c, const Reference *vr, size_t count, const double *values)
{
    size_t i;
    for (i = 0; i < count; i++) {
        const char kind = (vr[i] < COUNT) ? KIND[vr[i]] : '-';
        if ((kind != 'i') && (kind != 'p') && (kind != 's')) {
            return complain(c, STATUS_ERROR, "this value reference cannot be set");
        }
        if (!(fabs(values[i]) < HUGE_VAL)) {
            return complain(c, STATUS_ERROR, "a value that is set is NaN or infinite");
        }
        c->model.v[vr[i]] = values[i];
        if (kind == 'p') {
            c->model.prepared = 0;
        }
        if (kind == 's') {
            /* Which rows slide, and which way, is seen anew. */
            memset(c->model.mode, 0, sizeof c->model.mode);
            memset(c->model.sign, 0, sizeof c->model.sign);
        }
    }
    touch(&c->model);
    return STATUS_OK;
}

static Status get_status(Instance *c, const Reference *vr, size_t count, int *values)
{
    size_t i;
    for (i = 0; i < count; i++) {
        if (vr[i] != STATUS_AT) {
            return complain(c, STATUS_ERROR, "no integer variable has this value reference");
        }
        values[i] = results(&c->model);
    }
    return STATUS_OK;
}

static Status get_states(Instance *c, double *x, size_t count)
{
    if (count != STATES) {
        return complain(c, STATUS_ERROR, "a wrong number of continuous states");
    }
    memcpy(x, c->model.v + 1, count * sizeof *x);
    return STATUS_OK;
}

static Status set_states(Instance *c, const double *x, size_t count)
{
    if (count != STATES) {
        return complain(c, STATUS_ERROR, "a wrong number of continuous states");
    }
    memcpy(c->model.v + 1, x, count * sizeof *x);
    touch(&c->model);
    return STATUS_OK;
}

static Status get_rates(Instance *c, double *values, size_t count)
{
    const Status status = said(c, rates(&c->model));
    if (count != STATES) {
        return complain(c, STATUS_ERROR, "a wrong number of continuous states");
    }
    memcpy(values, c->model.v + 1 + STATES, count * sizeof *values);
    return status;
}

static Status get_indicators(Instance *c, double *values, size_t count)
{
    const Status status = said(c, rates(&c->model));
    if (count != DRY) {
        return complain(c, STATUS_ERROR, "a wrong number of event indicators");
    }
    memcpy(values, c->model.v + INDICATORS, count * sizeof *values);
    return status;
}

static Status nominals(double *values, size_t count)
{
    size_t i;
    for (i = 0; i < count; i++) {
        values[i] = 1.0;
    }
    return STATUS_OK;
}

static Status update(Instance *c, int *changed)
{
    return said(c, event(&c->model, changed));
}

/* A change of phase, which is possible from one phase alone. */
static Status enter(Instance *c, Phase from, Phase to)
{
    if (c->model.phase != from) {
        return complain(c, STATUS_ERROR, "a call out of order: instantiate, initialise, step, terminate");
    }
    c->model.phase = to;
    return STATUS_OK;
}

/* A step that fails leaves the state as it was. */
static Status do_step(Instance *c, double time, double span)
{
    const Model before = c->model;
    Status status;
    if (!((span >= 0.0) && (fabs(time) < HUGE_VAL) && (span < HUGE_VAL))) {
        return complain(c, STATUS_ERROR, "the step is negative, NaN or infinite");
    }
    if (enter(c, RUNNING, RUNNING) != STATUS_OK) {
        return STATUS_ERROR;
    }
    /* Times that a program adds up differ by rounding. */
    if (!(fabs(time - c->model.v[0]) <= 1e-9 * (1.0 + fabs(time)))) {
        return complain(c, STATUS_ERROR, "the step does not begin where the last one ended");
    }
    status = said(c, (span > 0.0) ? advance(&c->model, span) : 0);
    if (status != STATUS_OK) {
        c->model = before;
    } else {
        c->model.v[0] = time + span;
    }
    return status;
}

static Status copy_state(const Instance *c, void **state)
{
    if (*state == NULL) {
        *state = malloc(sizeof c->model);
    }
    if (*state == NULL) {
        return complain(c, STATUS_ERROR, "no memory for a state");
    }
    memcpy(*state, &c->model, sizeof c->model);
    return STATUS_OK;
}

/* FNV-1a of a state, begun with the token: a state of another FMU, or a damaged one, has another. */
static unsigned int hash_state(const void *state)
{
    const unsigned char *bytes = (const unsigned char *)state;
    const char *token = TOKEN;
    unsigned int hash = 2166136261U;
    size_t i;
    for (i = 0; token[i] != '\0'; i++) {
        hash = (hash ^ (unsigned char)token[i]) * 16777619U;
    }
    for (i = 0; i < sizeof(Model); i++) {
        hash = (hash ^ bytes[i]) * 16777619U;
    }
    return hash;
}

static Status restore(Instance *c, const void *state, size_t size)
{
    if ((state == NULL) || (size != sizeof c->model)) {
        return complain(c, STATUS_ERROR, "this is no state of this FMU");
    }
    memcpy(&c->model, state, sizeof c->model);
    return STATUS_OK;
}

static Status forget(void **state)
{
    free(*state);
    *state = NULL;
    return STATUS_OK;
}

static Status save(const Instance *c, const void *state, void *bytes, size_t size)
{
    const unsigned int hash = (state == NULL) ? 0U : hash_state(state);
    if ((state == NULL) || (size != SAVED)) {
        return complain(c, STATUS_ERROR, "a wrong size of a state");
    }
    memcpy(bytes, state, sizeof c->model);
    memcpy((char *)bytes + sizeof c->model, &hash, sizeof hash);
    return STATUS_OK;
}

static Status load(Instance *c, const void *bytes, size_t size, void **state)
{
    Model made;
    unsigned int hash;
    if ((bytes == NULL) || (size != SAVED)) {
        return complain(c, STATUS_ERROR, "this is no state of this FMU");
    }
    memcpy(&made, bytes, sizeof made);
    memcpy(&hash, (const char *)bytes + sizeof made, sizeof hash);
    if (hash != hash_state(&made)) {
        return complain(c, STATUS_ERROR, "this is no state of this FMU, or a damaged one");
    }
    if (copy_state(c, state) != STATUS_OK) {
        return STATUS_ERROR;
    }
    memcpy(*state, &made, sizeof made);
    return STATUS_OK;
}

static Status unsupported(const Instance *c, size_t count)
{
    return (count == 0) ? STATUS_OK : complain(c, STATUS_ERROR, "the FMU has no such function");
}
