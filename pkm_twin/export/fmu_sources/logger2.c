/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
typedef void (*Logger)(void *, const char *, Status, const char *, const char *, ...);
typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*free)(void *);
    void (*finished)(void *, Status);
    void *environment;
} Callbacks;
typedef struct {
    int need_update, terminate, nominals_changed, values_changed, time_defined;
    double time;
} EventInfo;
