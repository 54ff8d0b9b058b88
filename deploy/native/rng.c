/* Random numbers as numpy's default_rng(seed) and default_rng([seed, 1]) draw them.

   PCG64 (O'Neill's XSL-RR 128/64), seeded by numpy's SeedSequence; whole numbers by Lemire's
   method, normal and exponential ones by 256-layer ziggurats (Marsaglia and Tsang). */
#include "qsgm.h"

#include <math.h>

typedef unsigned __int128 Wide;

static const Wide multiplier = ((Wide)0x2360ED051FC65DA4u << 64) | 0x4385DF649FCCF645u;

static uint32_t stirred(uint32_t value, uint32_t *constant, uint32_t factor) {
    value ^= *constant;
    *constant *= factor;
    value *= *constant;
    return value ^ value >> 16;
}

static double bell(double x) { return exp(-0.5 * x * x); }
static double bell_inverse(double y) { return sqrt(-2 * log(y)); }
static double decay(double x) { return exp(-x); }
static double decay_inverse(double y) { return -log(y); }

/* Layer i reaches from 0 to x[i], where the curve is height[i]; all have one area. numpy keeps such
   numbers in tables, whose last bits may differ: what is drawn is rounded to whole numbers. */
static void stack(Ziggurat *z, double end, double area, double (*curve)(double),
                  double (*inverse)(double)) {
    for (int i = 255; i > 0; i--) {
        z->x[i] = i == 255 ? end : inverse(area / z->x[i + 1] + z->height[i + 1]);
        z->height[i] = curve(z->x[i]);
    }
    z->x[0] = area / z->height[255];
    z->height[0] = 1;
}

void rng_seed(Rng *rng, const uint32_t *entropy, int words) {
    uint32_t pool[4], constant = 0x43b0d7e5u, state[8];
    for (int i = 0; i < 4; i++)
        pool[i] = stirred(i < words ? entropy[i] : 0, &constant, 0x931e8875u);
    for (int from = 0; from < 4; from++)
        for (int to = 0; to < 4; to++)
            if (from != to) {
                uint32_t other = stirred(pool[from], &constant, 0x931e8875u);
                pool[to] = 0xca01f9ddu * pool[to] - 0x4973f715u * other;
                pool[to] ^= pool[to] >> 16;
            }
    constant = 0x8b51f9ddu;
    for (int i = 0; i < 8; i++)
        state[i] = stirred(pool[i % 4], &constant, 0x58f38dedu);
    uint64_t part[4];
    for (int i = 0; i < 4; i++)
        part[i] = state[2 * i] | (uint64_t)state[2 * i + 1] << 32;
    Wide start = (Wide)part[0] << 64 | part[1];
    rng->step = ((Wide)part[2] << 64 | part[3]) << 1 | 1;
    rng->state = (rng->step + start) * multiplier + rng->step;
    rng->has_half = 0;
    double end = 3.654152885361009, tail = sqrt(acos(0)) * erfc(end / sqrt(2));
    stack(&rng->normal, end, end * bell(end) + tail, bell, bell_inverse);
    end = 7.697117470131050;
    stack(&rng->exponential, end, (end + 1) * decay(end), decay, decay_inverse);
}

static uint64_t next64(Rng *rng) {
    rng->state = rng->state * multiplier + rng->step;
    uint64_t mixed = (uint64_t)(rng->state >> 64) ^ (uint64_t)rng->state;
    int turn = (int)(rng->state >> 122);
    return mixed >> turn | mixed << (-turn & 63);
}

static uint32_t next32(Rng *rng) { /* the upper half of a number is kept for the next call */
    rng->has_half = !rng->has_half;
    if (!rng->has_half)
        return rng->half;
    uint64_t both = next64(rng);
    rng->half = (uint32_t)(both >> 32);
    return (uint32_t)both;
}

double uniform(Rng *rng, double low, double high) {
    return low + (high - low) * ((double)(next64(rng) >> 11) / 9007199254740992.0);
}

double integer(Rng *rng, double low, double high) {
    uint32_t count = (uint32_t)(high - low);
    if (count <= 1)
        return low; /* nothing is drawn */
    uint64_t product = (uint64_t)next32(rng) * count;
    while ((uint32_t)product < (0u - count) % count)
        product = (uint64_t)next32(rng) * count;
    return low + (double)(product >> 32);
}

void shuffle(Rng *rng, int64_t *values, int count) {
    for (int i = count - 1; i > 0; i--) {
        uint32_t mask = (uint32_t)i, other;
        for (int shift = 1; shift < 32; shift *= 2)
            mask |= mask >> shift;
        while ((other = next32(rng) & mask) > (uint32_t)i)
            continue;
        int64_t kept = values[i];
        values[i] = values[other];
        values[other] = kept;
    }
}

/* Whether x lies in the part of a layer that is below the curve as a whole. */
static int inside(const Ziggurat *z, int layer, double x) {
    return x < (layer == 0 ? z->x[255] : layer == 1 ? 0 : z->x[layer - 1]);
}

static double between(Rng *rng, const Ziggurat *z, int layer) {
    return (z->height[layer - 1] - z->height[layer]) * uniform(rng, 0, 1) + z->height[layer];
}

double normal(Rng *rng, double mean, double deviation) {
    for (const Ziggurat *z = &rng->normal;;) {
        uint64_t drawn = next64(rng);
        int layer = drawn & 255, negative = drawn >> 8 & 1;
        double x = (double)(drawn >> 9 & 0xfffffffffffffu) * (z->x[layer] / 4503599627370496.0);
        if (!inside(z, layer, x) && layer == 0) { /* the tail beyond the last layer */
            double y;
            negative = drawn >> 17 & 1;
            do {
                x = -log1p(-uniform(rng, 0, 1)) / z->x[255];
                y = -log1p(-uniform(rng, 0, 1));
            } while (y + y <= x * x);
            x += z->x[255];
        } else if (!inside(z, layer, x) && between(rng, z, layer) >= bell(x))
            continue;
        return mean + deviation * (negative ? -x : x);
    }
}

double exponential(Rng *rng, double low, double mean) {
    for (const Ziggurat *z = &rng->exponential;;) {
        uint64_t drawn = next64(rng) >> 3;
        int layer = drawn & 255;
        double x = (double)(drawn >> 8) * (z->x[layer] / 9007199254740992.0);
        if (inside(z, layer, x))
            return low + mean * x;
        if (layer == 0)
            return low + mean * (z->x[255] - log1p(-uniform(rng, 0, 1)));
        if (between(rng, z, layer) < decay(x))
            return low + mean * x;
    }
}
