/* The estimate-and-control step written by hand in C: straight-line code for the ordinary tick, with all constants computed
 * once. The reference for the product's step; not part of the product.
 *
 * Same samples in, same samples out, same checks: finite, complete, the next tick, enough signal. Any other
 * tick is detected and refused with 0, where the product continues; nothing else is left out. */

#include <math.h>
#include <stdint.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))
/* Packing neighbouring scalars costs more than it saves here: a step would load in pairs what the last one stored singly. */
#if defined(__GNUC__) && !defined(__clang__)
#define STEP EXPORT __attribute__((optimize("no-tree-slp-vectorize")))
#else
#define STEP EXPORT
#endif
#define RARE(x) __builtin_expect(!!(x), 0)

enum { INITIAL = 1 << 2, UNOBSERVABLE = 1 << 3, LEARNING = 1 << 5, NOT_EXCITED = 1 << 8, FAULT = 1 << 9 };

struct stamp { uint64_t tick, generation, origin_ns, sent_ns; };

struct rate_measurement { struct stamp stamp; double omega[3], applied[3]; uint64_t valid, status; };
struct rate_estimate {
    struct stamp stamp;
    double omega[3], innovation, coefficients[3], closure, ratios[2], excitation;
    uint64_t valid, status;
};
struct rate_command { struct stamp stamp; double acceleration[3], lyapunov, lyapunov_rate; };

struct orbit_measurement { struct stamp stamp; double r, theta, velocity[2], applied[2]; uint64_t valid, status; };
struct orbit_estimate { struct stamp stamp; double r, theta, velocity[2]; uint64_t valid, status; };
struct orbit_command { struct stamp stamp; double thrust[2]; };

static inline double square(double x) { return x * x; }
static inline double larger(double x, double y) { return x > y ? x : y; }
static inline double smaller(double x, double y) { return x < y ? x : y; }

/* ---- A hidden component of a rigid body's angular velocity: axis 3, on an ellipse; filters of either order. ---- */

struct hidden_parameters {
    double inertia[3], gain[3];
    double decay, bandwidth; /* one of the two; the other is 0 */
    double guess, floor, acceleration_max, rate_bound, tick;
};

struct hidden {
    double a1, a2, a3, gain1, gain2, gain3, limit;
    /* The constant part of the estimate, in its order: coefficients, closure, ratios, excitation. */
    double body[7];
    /* The relation, in x = om i and y = a1 j with om = sqrt(-a1 a2): products of constants. */
    double om, scale, product, bend, floor_square, turn_limit;
    double h, h6, h2, hh12, moment[4];
    /* The filters: the remaining part of the error, or the two gains. */
    double left, gain_potential, gain_unknown;
    double slope1, slope2, slope3, hidden_slope;
    /* The state: the last sample, and the filter. */
    double x, y, square, drift, turning, u1, u2, u3, w, residual;
    uint64_t tick;
    int started, second, judged;
};

EXPORT uint64_t hidden_size(void) { return sizeof(struct hidden); }

EXPORT void hidden_start(struct hidden *s, const struct hidden_parameters *p) {
    memset(s, 0, sizeof *s);
    const double *I = p->inertia;
    double h = p->tick, a1 = (I[1] - I[2]) / I[0], a2 = (I[2] - I[0]) / I[1], a3 = (I[0] - I[1]) / I[2];
    double om = sqrt(-a1 * a2);
    s->a1 = a1, s->a2 = a2, s->a3 = a3;
    s->gain1 = p->gain[0], s->gain2 = p->gain[1], s->gain3 = p->gain[2];
    s->limit = p->acceleration_max;
    double body[7] = { a1, a2, a3, a1 + a2 + a3 + a1 * a2 * a3, I[1] / I[0], I[2] / I[0], 0 };
    memcpy(s->body, body, sizeof body);
    s->om = om;
    s->scale = 1 / (om * h);
    s->product = a3 / (om * a1);
    s->bend = a3 / a1;
    s->floor_square = square(p->floor * larger(om, fabs(a1)));
    s->turn_limit = 3 / (om * h);
    s->h = h, s->h6 = h / 6, s->h2 = h / 2, s->hh12 = h * h / 12;
    s->moment[0] = 0.35 * h, s->moment[1] = 0.15 * h, s->moment[2] = h * h / 20, s->moment[3] = h * h / 30;
    s->second = p->bandwidth > 0;
    s->judged = !s->second;
    s->left = exp(-p->decay * h);
    double damping = sqrt(0.5), turn = p->bandwidth * h, root = turn * sqrt(1 - damping * damping);
    double fall = expm1(-damping * turn), half = sin(0.5 * root);
    s->gain_potential = -expm1(-2 * damping * turn);
    s->gain_unknown = (fall * fall + 4 * (1 + fall) * half * half) / h;
    double pull1 = fabs(a1) * p->rate_bound, pull2 = fabs(a2) * p->rate_bound;
    s->slope1 = p->gain[0] - pull1;
    s->slope2 = p->gain[1] - pull2;
    s->slope3 = p->gain[2] / 2;
    s->hidden_slope = p->decay - pull1 - pull2 - p->gain[2] / 2;
    s->w = p->guess;
}

/* atan2 for the small rotation of one tick; below 0.03 the series is exact to a rounding. */
static inline double turn(double cross, double dot) {
    double t = cross / dot;
    if (RARE(!(fabs(t) < 0.03 && dot > 0)))
        return atan2(cross, dot);
    double z = t * t;
    return t + t * z * (-1.0 / 3 + z * (1.0 / 5 + z * (-1.0 / 7 + z * (1.0 / 9 - z * (1.0 / 11)))));
}

STEP int hidden_step(struct hidden *s, const struct rate_measurement *m, const struct rate_measurement *own,
                     struct rate_estimate *e, struct rate_command *c) {
    double i = m->omega[0], j = m->omega[1], u1 = m->applied[0], u2 = m->applied[1], u3 = m->applied[2];
    double finite = ((i + j) + (m->omega[2] + u1) + (u2 + u3)) * 0;
    if (RARE((m->valid & 3) != 3 || finite != 0))
        return 0;
    double x = s->om * i, y = s->a1 * j, xx = x * x, yy = y * y, squares = xx + yy;
    double drifting = s->product * x * y, turning = s->bend * (yy - xx);
    double w = s->w, innovation = 0;
    uint64_t status = INITIAL, valid = 3;
    if (__builtin_expect(s->started, 1)) {
        int ordinary = m->stamp.tick == s->tick + 1 && smaller(squares, s->square) > s->floor_square &&
                       fabs(w) <= s->turn_limit && s->u1 == 0 && s->u2 == 0;
        if (RARE(!ordinary))
            return 0;
        /* The torque of the last sample is held over the step. */
        double g0 = s->drift + s->u3, g1 = drifting + s->u3;
        double mean = turn(s->y * x - s->x * y, s->x * x + s->y * y) * s->scale;
        double bend0 = (mean - s->h6 * (2 * g0 + g1)) * s->turning;
        double bend1 = (mean + s->h6 * (g0 + 2 * g1)) * turning;
        double drift = s->h2 * (g0 + g1) + s->hh12 * (bend0 - bend1);
        double moment = (s->moment[0] * g0 + s->moment[1] * g1) + (s->moment[2] * bend0 - s->moment[3] * bend1);
        double start = mean - moment, end = start + drift;
        if (s->second) {
            double off = s->residual + (start - w) * s->h;
            w += drift + s->gain_unknown * off;
            s->residual = off - s->gain_potential * off;
        } else {
            w = end + s->left * (w - start);
        }
        innovation = end - w;
        status = 0;
        valid = 7;
    }
    s->started = 1;
    s->tick = m->stamp.tick;
    s->x = x, s->y = y, s->square = squares, s->drift = drifting, s->turning = turning;
    s->u1 = u1, s->u2 = u2, s->u3 = u3;
    s->w = w;

    e->stamp.tick = c->stamp.tick = m->stamp.tick;
    e->stamp.origin_ns = c->stamp.origin_ns = m->stamp.origin_ns;
    e->omega[0] = i, e->omega[1] = j, e->omega[2] = w;
    e->innovation = innovation;
    memcpy(e->coefficients, s->body, sizeof s->body);
    e->valid = valid;
    e->status = status;

    double p1 = own->omega[0], p2 = own->omega[1], p3 = own->omega[2];
    double d1 = p1 - i, d2 = p2 - j, d3 = p3 - w;
    double c1 = s->a1 * (j * w - p2 * p3) - s->gain1 * d1;
    double c2 = s->a2 * (w * i - p3 * p1) - s->gain2 * d2;
    double c3 = s->a3 * (i * j - p1 * p2) - s->gain3 * d3;
    double largest = larger(fabs(c1), larger(fabs(c2), fabs(c3)));
    if (RARE(largest > s->limit)) {
        double scale = s->limit / largest;
        c1 *= scale, c2 *= scale, c3 *= scale;
    }
    c->acceleration[0] = c1, c->acceleration[1] = c2, c->acceleration[2] = c3;
    double lyapunov = 0, rate = 0;
    if (s->judged) {
        d3 -= innovation;
        double q1 = d1 * d1, q2 = d2 * d2, q3 = d3 * d3, hidden = innovation * innovation;
        lyapunov = 0.5 * ((q1 + q2) + (q3 + hidden));
        rate = -((s->slope1 * q1 + s->slope2 * q2) + (s->slope3 * q3 + s->hidden_slope * hidden));
    }
    c->lyapunov = lyapunov;
    c->lyapunov_rate = rate;
    return 1;
}

/* ---- The inertia of a body whose rates are all measured, with a full decay matrix. ---- */

struct identifier_parameters { double decay[9]; double floor, tick; };

struct identifier {
    double matrix[9], norm, floor, h;
    double last[3], torque[3], a[3], excitation;
    uint64_t tick;
    int started;
};

EXPORT uint64_t identifier_size(void) { return sizeof(struct identifier); }

EXPORT void identifier_start(struct identifier *s, const struct identifier_parameters *p) {
    memset(s, 0, sizeof *s);
    memcpy(s->matrix, p->decay, sizeof s->matrix); /* row by row */
    for (int column = 0; column < 3; column++) {
        double sum = 0;
        for (int row = 0; row < 3; row++)
            sum += fabs(p->decay[3 * row + column]);
        s->norm = larger(s->norm, sum);
    }
    s->floor = larger(p->floor, 1e-12);
    s->h = p->tick;
}

/* v := e^(A weight) v by its series on the vector: a matrix times a vector per degree, halved if the norm is too large. */
static inline void decay(const struct identifier *s, double weight, double v[3]) {
    double norm = s->norm * weight;
    int pieces = 1, degree = 6;
    if (RARE(norm > 0.015)) {
        degree = 14;
        while (norm > 0.5)
            norm *= 0.5, pieces *= 2;
    }
    double scale = weight / pieces;
    const double *A = s->matrix;
    for (int piece = 0; piece < pieces; piece++) {
        double x = v[0], y = v[1], z = v[2];
        for (int k = degree; k > 0; k--) {
            double f = scale / k;
            double nx = v[0] + f * (A[0] * x + A[1] * y + A[2] * z);
            double ny = v[1] + f * (A[3] * x + A[4] * y + A[5] * z);
            double nz = v[2] + f * (A[6] * x + A[7] * y + A[8] * z);
            x = nx, y = ny, z = nz;
        }
        v[0] = x, v[1] = y, v[2] = z;
    }
}

static inline void velocity(const double a[3], const double w[3], const double u[3], double out[3]) {
    out[0] = a[0] * w[1] * w[2] + u[0];
    out[1] = a[1] * w[2] * w[0] + u[1];
    out[2] = a[2] * w[0] * w[1] + u[2];
}

struct path { double b[4][3], a[3], u[3], h; };
struct piece { double potential[3], weight; };

static inline void at(const struct path *p, double t, double out[3]) {
    double l = 1 - t, c0 = l * l * l, c1 = 3 * l * l * t, c2 = 3 * l * t * t, c3 = t * t * t;
    for (int axis = 0; axis < 3; axis++)
        out[axis] = c0 * p->b[0][axis] + c1 * p->b[1][axis] + c2 * p->b[2][axis] + c3 * p->b[3][axis];
}

static inline struct piece between(const struct path *p, const double from[3], const double middle[3],
                                   const double to[3], double part) {
    struct piece piece;
    double sixth = p->h * part * (1.0 / 6);
    double first = from[0] * from[1] * from[2], central = middle[0] * middle[1] * middle[2], last = to[0] * to[1] * to[2];
    piece.weight = (fabs(first) + 4 * fabs(central) + fabs(last)) * sixth;
    double sign = copysign(1, central);
    for (int axis = 0; axis < 3; axis++) {
        double turned = (from[axis] + 4 * middle[axis] + to[axis]) * sixth;
        double energy = 0.5 * (to[axis] - from[axis]) * (to[axis] + from[axis]);
        piece.potential[axis] = (energy - p->u[axis] * turned) * sign;
    }
    return piece;
}

static struct piece part_of(const struct path *p, double begin, double end) {
    double from[3], middle[3], to[3];
    at(p, begin, from);
    at(p, 0.5 * (begin + end), middle);
    at(p, end, to);
    return between(p, from, middle, to, end - begin);
}

/* Counts the sign changes of the control points. */
static inline int changes(const struct path *p, int axis) {
    double b0 = p->b[0][axis], b1 = p->b[1][axis], b2 = p->b[2][axis], b3 = p->b[3][axis];
    if (__builtin_expect((b0 > 0 && b1 > 0 && b2 > 0 && b3 > 0) || (b0 < 0 && b1 < 0 && b2 < 0 && b3 < 0), 1))
        return 0;
    int count = 0;
    double last = 0;
    for (int k = 0; k < 4; k++) {
        double value = p->b[k][axis];
        count += value * last < 0;
        last = value == 0 ? last : value;
    }
    return count;
}

static int explained(const struct path *p) {
    double w[3], v0[3], v1[3], v2[3], moved = 0, unexplained = 0;
    at(p, 0, w), velocity(p->a, w, p->u, v0);
    at(p, 0.5, w), velocity(p->a, w, p->u, v1);
    at(p, 1, w), velocity(p->a, w, p->u, v2);
    for (int axis = 0; axis < 3; axis++) {
        double d = p->b[3][axis] - p->b[0][axis];
        moved += d * d;
        unexplained += square(d - (v0[axis] + 4 * v1[axis] + v2[axis]) * (p->h / 6));
    }
    return unexplained <= 0.05 * 0.05 * moved;
}

static double zero_of(const struct path *p, int axis) {
    double start = 0, low = 0, high = 1, w[3];
    for (int k = 0; k < 4 && start == 0; k++)
        start = p->b[k][axis];
    for (int halving = 0; halving < 53; halving++) {
        double middle = 0.5 * (low + high);
        at(p, middle, w);
        if (w[axis] * start > 0)
            low = middle;
        else
            high = middle;
    }
    return 0.5 * (low + high);
}

/* Updates the estimate with one step; returns the status bits that explain an unused step. */
static uint64_t learn(struct identifier *s, const double to[3]) {
    struct path p;
    double v0[3], v1[3], third = s->h * (1.0 / 3), middle[3];
    p.h = s->h;
    for (int axis = 0; axis < 3; axis++) {
        p.a[axis] = smaller(larger(s->a[axis], -1), 1);
        p.u[axis] = s->torque[axis];
    }
    velocity(p.a, s->last, p.u, v0);
    velocity(p.a, to, p.u, v1);
    for (int axis = 0; axis < 3; axis++) {
        p.b[0][axis] = s->last[axis];
        p.b[1][axis] = s->last[axis] + v0[axis] * third;
        p.b[2][axis] = to[axis] - v1[axis] * third;
        p.b[3][axis] = to[axis];
        middle[axis] = 0.5 * (s->last[axis] + to[axis]) + 0.125 * s->h * (v0[axis] - v1[axis]);
    }
    struct piece used = between(&p, s->last, middle, to, 1);
    double least = s->floor * s->h;
    if (RARE(!(used.weight > least)))
        return NOT_EXCITED;
    int found[3] = { changes(&p, 0), changes(&p, 1), changes(&p, 2) };
    if (RARE(found[0] | found[1] | found[2])) {
        if (found[0] + found[1] + found[2] != 1 || !explained(&p))
            return UNOBSERVABLE;
        double zero = zero_of(&p, found[0] ? 0 : found[1] ? 1 : 2);
        struct piece after = part_of(&p, zero, 1);
        used = part_of(&p, 0, zero);
        used.weight += after.weight;
        for (int axis = 0; axis < 3; axis++)
            used.potential[axis] += after.potential[axis];
        if (!(used.weight > least))
            return NOT_EXCITED;
    }
    s->excitation += used.weight;
    double start[3], error[3], inverse = 1 / used.weight;
    for (int axis = 0; axis < 3; axis++) {
        start[axis] = used.potential[axis] * inverse;
        error[axis] = s->a[axis] - start[axis];
    }
    decay(s, used.weight, error);
    for (int axis = 0; axis < 3; axis++)
        s->a[axis] = start[axis] + error[axis];
    return 0;
}

EXPORT int identifier_step(struct identifier *s, const struct rate_measurement *m, const struct rate_measurement *own,
                           struct rate_estimate *e, struct rate_command *c) {
    (void)own, (void)c;
    const double *w = m->omega, *u = m->applied;
    double finite = (w[0] + w[1] + w[2] + u[0] + u[1] + u[2]) * 0;
    if (RARE((m->valid & 7) != 7 || finite != 0))
        return 0;
    uint64_t status = INITIAL;
    if (__builtin_expect(s->started, 1)) {
        if (RARE(m->stamp.tick != s->tick + 1))
            return 0;
        status = LEARNING | learn(s, w);
    }
    s->started = 1;
    s->tick = m->stamp.tick;
    memcpy(s->last, w, sizeof s->last);
    memcpy(s->torque, u, sizeof s->torque);

    /* The best-fitting moments: the longest of three cross products. */
    const double *a = s->a;
    double forms[3][3] = { { 1 - a[1], 1 + a[0], 1 + a[0] * a[1] },
                           { 1 + a[1] * a[2], 1 - a[2], 1 + a[1] },
                           { 1 + a[2], 1 + a[2] * a[0], 1 - a[0] } };
    const double *moments = forms[0];
    double longest = square(moments[0]) + square(moments[1]) + square(moments[2]);
    for (int form = 1; form < 3; form++) {
        const double *f = forms[form];
        double length = square(f[0]) + square(f[1]) + square(f[2]);
        if (length > longest)
            longest = length, moments = f;
    }
    double inverse = 1 / moments[0], closure = a[0] + a[1] + a[2] + a[0] * a[1] * a[2];
    int body = moments[0] > 0 && moments[1] > 0 && moments[2] > 0 && closure * 0 == 0;
    e->stamp.tick = m->stamp.tick;
    e->stamp.origin_ns = m->stamp.origin_ns;
    memcpy(e->omega, w, sizeof e->omega);
    e->innovation = 0;
    memcpy(e->coefficients, a, sizeof e->coefficients);
    e->closure = closure;
    e->ratios[0] = body ? moments[1] * inverse : 0;
    e->ratios[1] = body ? moments[2] * inverse : 0;
    e->excitation = s->excitation;
    e->valid = 7;
    e->status = status;
    return 1;
}

/* ---- The velocity of a body in orbit, and the law that steers it to a circle. ---- */

struct orbit_parameters { double mu, decay[2], guess[2], target, gains[3], thrust_max, tick; };

struct orbit {
    double mu, h, inverse_h, left[2], guess[2], target, wanted, gains[3], limit;
    double r, cos, sin, vx, vy, thrust[2];
    uint64_t tick;
    int started;
};

EXPORT uint64_t orbit_size(void) { return sizeof(struct orbit); }

EXPORT void orbit_start(struct orbit *s, const struct orbit_parameters *p) {
    memset(s, 0, sizeof *s);
    s->mu = p->mu;
    s->h = p->tick;
    s->inverse_h = 1 / p->tick;
    for (int axis = 0; axis < 2; axis++) {
        s->left[axis] = exp(-p->decay[axis] * p->tick);
        s->guess[axis] = p->guess[axis];
    }
    s->target = p->target;
    double circular = sqrt(p->mu / p->target);
    s->wanted = circular;
    memcpy(s->gains, p->gains, sizeof s->gains);
    s->limit = p->thrust_max;
}

STEP int orbit_step(struct orbit *s, const struct orbit_measurement *m, const struct orbit_measurement *own,
                    struct orbit_estimate *e, struct orbit_command *c) {
    double r = m->r, theta = m->theta;
    double finite = (r + theta + m->applied[0] + m->applied[1]) * 0;
    if (RARE((m->valid & 3) != 3 || (m->status & FAULT) || !(r > 0) || finite != 0))
        return 0;
    double sin, cos;
    __builtin_sincos(theta, &sin, &cos);
    uint64_t status = INITIAL, valid = 3;
    if (__builtin_expect(s->started, 1)) {
        if (RARE(m->stamp.tick != s->tick + 1))
            return 0;
        double h = s->h, ur = s->thrust[0], ut = s->thrust[1];
        double pull0 = s->mu / (s->r * s->r), pull1 = s->mu / (r * r);
        double g0r = ur - pull0, g1r = ur - pull1;
        double g0x = s->cos * g0r - s->sin * ut, g0y = s->sin * g0r + s->cos * ut;
        double g1x = cos * g1r - sin * ut, g1y = sin * g1r + cos * ut;
        double mx = (cos * r - s->cos * s->r) * s->inverse_h, my = (sin * r - s->sin * s->r) * s->inverse_h;
        double v0x = mx - (2 * g0x + g1x) * (h / 6), v0y = my - (2 * g0y + g1y) * (h / 6);
        double v1x = mx + (g0x + 2 * g1x) * (h / 6), v1y = my + (g0y + 2 * g1y) * (h / 6);
        double i0 = 1 / s->r, i1 = 1 / r;
        double a0 = (v0x * s->cos + v0y * s->sin) * i0, t0 = (v0y * s->cos - v0x * s->sin) * i0;
        double a1 = (v1x * cos + v1y * sin) * i1, t1 = (v1y * cos - v1x * sin) * i1;
        double s0r = 2 * pull0 * a0 - t0 * ut, s0t = t0 * (ur - pull0);
        double s1r = 2 * pull1 * a1 - t1 * ut, s1t = t1 * (ur - pull1);
        double s0x = s->cos * s0r - s->sin * s0t, s0y = s->sin * s0r + s->cos * s0t;
        double s1x = cos * s1r - sin * s1t, s1y = sin * s1r + cos * s1t;
        double hh = h * h;
        double dx = (g0x + g1x) * (0.5 * h) + (s0x - s1x) * (hh / 12);
        double dy = (g0y + g1y) * (0.5 * h) + (s0y - s1y) * (hh / 12);
        double qx = (7 * g0x + 3 * g1x) * (h / 20) + (3 * s0x - 2 * s1x) * (hh / 60);
        double qy = (7 * g0y + 3 * g1y) * (h / 20) + (3 * s0y - 2 * s1y) * (hh / 60);
        double bx = mx - qx, by = my - qy;
        s->vx = bx + dx + s->left[0] * (s->vx - bx);
        s->vy = by + dy + s->left[1] * (s->vy - by);
        status = 0;
        valid = 15;
    } else {
        s->vx = s->guess[0] * cos - s->guess[1] * sin;
        s->vy = s->guess[0] * sin + s->guess[1] * cos;
    }
    s->started = 1;
    s->tick = m->stamp.tick;
    s->r = r;
    s->cos = cos;
    s->sin = sin;
    s->thrust[0] = m->applied[0];
    s->thrust[1] = m->applied[1];

    double vr = s->vx * cos + s->vy * sin, vt = s->vy * cos - s->vx * sin;
    e->stamp.tick = c->stamp.tick = m->stamp.tick;
    e->stamp.origin_ns = c->stamp.origin_ns = m->stamp.origin_ns;
    e->r = r;
    e->theta = theta;
    e->velocity[0] = vr;
    e->velocity[1] = vt;
    e->valid = valid;
    e->status = status;

    if (RARE(own->status & FAULT))
        return 0;
    double br = own->r, ib = 1 / br, circular = s->wanted;
    double free_wanted = (circular * circular - s->mu / s->target) / s->target;
    double free_own = (vt * vt - s->mu * ib) * ib;
    double ur = free_wanted - free_own - s->gains[0] * (br - s->target) - s->gains[1] * vr;
    double ut = vr * vt * ib - s->gains[2] * (vt - circular);
    if (RARE((ur + ut) * 0 != 0))
        ur = ut = 0;
    c->thrust[0] = smaller(larger(ur, -s->limit), s->limit);
    c->thrust[1] = smaller(larger(ut, -s->limit), s->limit);
    return 1;
}
