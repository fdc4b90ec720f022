/* Compensation filters, written by @PROGRAM@. C99; numbers are exact doubles.
 *
 *     shakercal_filter filter;
 *     shakercal_start(&filter, &compensate_Fz, 0, first_sample);
 *     for (;;) out = shakercal_step(&filter, in);
 *     shakercal_switch(&filter, 2);    load number 2 of the table, from the next sample on, without a jump
 *
 * With -ffp-contract=off the output has the bits of the program's own. Samples must be finite.
 */
#ifndef SHAKERCAL_COMPENSATION_H
#define SHAKERCAL_COMPENSATION_H

#define SHAKERCAL_MOST_SECTIONS @MOST@

typedef struct {
    int sections, loads;
    double sample_rate_hz;
    const double *load_mass, *gain, *sos; /* kg; out of the last section; b0 b1 b2 a1 a2 by load and section */
} shakercal_table;

typedef struct {
    const shakercal_table *table;
    int load;
    double past[SHAKERCAL_MOST_SECTIONS + 1][2]; /* the last two values before and after every section, older first */
    double state[SHAKERCAL_MOST_SECTIONS][2];
} shakercal_filter;

static inline const double *shakercal_section(const shakercal_filter *filter, int section)
{
    return filter->table->sos + 5 * (filter->load * filter->table->sections + section);
}

/* Use the coefficients of another load from the next sample on. */
static inline void shakercal_switch(shakercal_filter *filter, int load)
{
    filter->load = load;
    for (int s = 0; s < filter->table->sections; s++) {
        const double *c = shakercal_section(filter, s), *x = filter->past[s], *y = filter->past[s + 1];
        filter->state[s][1] = c[2] * x[1] - c[4] * y[1];
        filter->state[s][0] = c[1] * x[1] - c[3] * y[1] + c[2] * x[0] - c[4] * y[0];
    }
}

/* Start as if the input had been at one level for ever. */
static inline void shakercal_start(shakercal_filter *filter, const shakercal_table *table, int load, double level)
{
    filter->table = table;
    filter->load = load;
    filter->past[0][0] = filter->past[0][1] = level;
    for (int s = 0; s < table->sections; s++) {
        const double *c = shakercal_section(filter, s);
        filter->past[s + 1][0] = filter->past[s][0] * ((c[0] + c[1] + c[2]) / (1.0 + c[3] + c[4]));
        filter->past[s + 1][1] = filter->past[s + 1][0];
    }
    shakercal_switch(filter, load);
}

/* One sample in, one sample out. */
static inline double shakercal_step(shakercal_filter *filter, double value)
{
    filter->past[0][0] = filter->past[0][1];
    filter->past[0][1] = value;
    for (int s = 0; s < filter->table->sections; s++) {
        const double *c = shakercal_section(filter, s);
        double *z = filter->state[s], out = c[0] * value + z[0];
        z[0] = c[1] * value - c[3] * out + z[1];
        z[1] = c[2] * value - c[4] * out;
        value = out;
        filter->past[s + 1][0] = filter->past[s + 1][1];
        filter->past[s + 1][1] = value;
    }
    return filter->table->gain[filter->load] * value;
}

@TABLES@
#endif
