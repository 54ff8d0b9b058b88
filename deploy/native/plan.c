/* One frame becomes 1000 labelled crops, the very bytes that the Python side cuts.

   All that is random is drawn first. */
#include "qsgm.h"

#include <math.h>
#include <stdlib.h>

/* The random numbers of a crop, in the order in which they are drawn: each for all crops at once. */
typedef struct {
    double at[2], jitter[2], near, direction, distance, anywhere[2], turn;
    double contrast, saturation, white[3], brightness, dims, dim, addition;
    double light, tint[3], shadow_direction, shadow_length, shadow_radius, shadow_strength;
    double thing, off_middle[2], thing_turn, scale, beside_direction, beside_distance;
    double kind, edge_turn, edge_middle[2], gap_width, sheet_width, sheet_length, softens, softness;
    double grey, color[3], grain, tile, corner[2];
} Draws;

typedef double Draw(Rng *rng, double low, double high);

static void draw(Rng *rng, double *first, size_t bytes, Draw *how, double low, double high) {
    for (int i = 0; i < CROPS; i++)
        for (size_t k = 0; k < bytes / sizeof(double); k++)
            first[(size_t)i * sizeof(Draws) / sizeof(double) + k] = how(rng, low, high);
}

#define DRAW(field, how, low, high) draw(rng, (double *)&d->field, sizeof d->field, how, low, high)

static void draw_point(Rng *rng, double *point, const Frame *frame) {
    point[0] = uniform(rng, HALF, frame->width - HALF);
    point[1] = uniform(rng, HALF, frame->height - HALF);
}

static double within(double value, double low, double high) { return fmin(fmax(value, low), high); }

/* Where windows are cut: on the object, or at least 28 px from it. */
static void draw_windows(Draws *d, Rng *rng, const Frame *frame, const double *center) {
    DRAW(jitter, uniform, -4, 4);
    DRAW(near, uniform, 0, 1);
    DRAW(direction, uniform, -PI, PI);
    DRAW(distance, uniform, 28, 64);
    for (int i = 0; i < CROPS; i++)
        draw_point(rng, d[i].anywhere, frame);
    const double high[2] = {frame->width - HALF, frame->height - HALF};
    for (int i = 0; i < CROPS; i++) {
        double ring[2] = {d[i].distance * cos(d[i].direction), d[i].distance * sin(d[i].direction)};
        for (int k = 0; k < 2; k++) {
            d[i].at[k] = d[i].near < 0.5 ? ring[k] + center[k] : d[i].anywhere[k];
            d[i].at[k] = within(d[i].at[k], HALF, high[k]);
            d[i].jitter[k] = within(center[k] + d[i].jitter[k], HALF, high[k]);
        }
    }
    for (int moved = 1; moved;) {
        moved = 0;
        for (int i = 0; i < CROPS; i++) {
            double x = d[i].at[0] - center[0], y = d[i].at[1] - center[1];
            if (sqrt(x * x + y * y) < 28) {
                draw_point(rng, d[i].at, frame);
                moved = 1;
            }
        }
    }
}

static void draw_all(Draws *d, Rng *rng, const Frame *frame, const double *center, int things) {
    draw_windows(d, rng, frame, center);
    DRAW(turn, uniform, -PI, PI);
    DRAW(contrast, uniform, 0.8, 1.25);
    DRAW(saturation, uniform, 0.7, 1.3);
    DRAW(white, uniform, 0.9, 1.1);
    DRAW(brightness, uniform, -25, 25);
    if (!things) {
        DRAW(dims, uniform, 1, 1); /* none of them */
        return;
    }
    DRAW(dims, uniform, 0, 1);
    DRAW(dim, uniform, 0.45, 1);
    DRAW(addition, uniform, 0, 1);
    DRAW(light, uniform, 0.75, 1.2);
    DRAW(tint, uniform, 0.9, 1.1);
    DRAW(shadow_direction, uniform, -PI, PI);
    DRAW(shadow_length, uniform, 0, 8);
    DRAW(shadow_radius, integer, 1, 5);
    DRAW(shadow_strength, uniform, 0, 0.6);
    DRAW(thing, integer, 0, things);
    DRAW(off_middle, uniform, -4, 4);
    DRAW(thing_turn, uniform, -PI, PI);
    DRAW(scale, uniform, 0.8, 1.2);
    DRAW(beside_direction, uniform, -PI, PI);
    DRAW(beside_distance, uniform, 42, 84);
    DRAW(kind, integer, 0, 3);
    DRAW(edge_turn, uniform, -PI, PI);
    DRAW(edge_middle, uniform, -24, 24);
    DRAW(gap_width, uniform, 1.5, 20);
    DRAW(sheet_width, uniform, 12, 60);
    DRAW(sheet_length, uniform, 12, 60);
    DRAW(softens, uniform, 0, 1);
    DRAW(softness, uniform, 3, 16);
    DRAW(grey, uniform, 0, 1);
    DRAW(color, normal, 0, 30);
    DRAW(grain, exponential, 0, 10);
    DRAW(tile, integer, 0, 2);
    DRAW(corner, integer, 0, 65);
}

static void set_window(Crop *c, const Draws *d) {
    const double *at = c->shown ? d->jitter : d->at, luma[3] = {0.114, 0.587, 0.299};
    c->turn = (float)d->turn;
    double cosine = cos((double)c->turn), sine = sin((double)c->turn);
    double map[6] = {cosine, -sine, (float)at[0] - (cosine * HALF - sine * HALF),
                     sine, cosine, (float)at[1] - (sine * HALF + cosine * HALF)};
    for (int i = 0; i < 6; i++)
        c->map[i] = (float)map[i];
    for (int i = 0; i < 3; i++) {
        float row[4];
        for (int k = 0; k < 3; k++)
            row[k] = (float)(d->contrast * d->white[i] *
                             (d->saturation * (i == k) + (1 - d->saturation) * luma[k]));
        row[3] = (float)(d->brightness + 128 * (1 - d->contrast));
        for (int k = 0; k < 4; k++) {
            float dimmed = (float)(row[k] * (d->dims < 0.4 ? d->dim : 1.0));
            c->color[i][k] = (int)rintf(dimmed * 1024) + (k < 3 ? 0 : 512);
        }
    }
}

static void set_thing(Crop *c, const Draws *d) {
    const double direction[2] = {cos(d->shadow_direction), sin(d->shadow_direction)};
    const double beside[2] = {cos(d->beside_direction), sin(d->beside_direction)};
    c->thing = (int)d->thing;
    c->thing_turn = (float)d->thing_turn;
    c->scale = (float)d->scale;
    c->shadow_radius = (int)d->shadow_radius;
    c->shadow_strength = (int)rint(d->shadow_strength * 255);
    for (int k = 0; k < 3; k++)
        c->gain[k] = (int)rint(d->light * d->tint[k] * 256);
    for (int k = 0; k < 2; k++) {
        c->shadow[k] = (int)rint(d->shadow_length * direction[k]);
        c->middle[k] = (float)(c->shown ? HALF + d->beside_distance * beside[k]
                                        : HALF + d->off_middle[k]);
    }
}

/* Half planes of an edge (kind 0), a gap (1: without ends) or a sheet (2), and their colour. */
static void set_edge(Crop *c, const Draws *d) {
    int kind = (int)d->kind;
    double softness = d->softens < 0.3 ? d->softness : 1, steep = 255 * 256 / softness;
    for (int quarter = 0; quarter < 4; quarter++) {
        double inward = d->edge_turn + quarter * PI / 2, near = quarter % 2 ? d->sheet_length
                        : kind == 1 ? d->gap_width : d->sheet_width;
        if (kind < (quarter % 2 ? 2 : 1))
            near = quarter == 0 ? 0 : 1e3; /* nothing is hidden on this side */
        double x = cos(inward), y = sin(inward);
        near -= x * (HALF + d->edge_middle[0]) + y * (HALF + d->edge_middle[1]);
        c->planes[quarter][0] = (int)rint(x * steep);
        c->planes[quarter][1] = (int)rint(y * steep);
        c->planes[quarter][2] = (int)rint((near + softness / 2) * steep);
    }
    for (int k = 0; k < 3; k++)
        c->surface[k] = (int)within((d->grey * 255 + d->color[k]) * (kind == 1 ? 0.35 : 1), 0, 255);
    c->grain = (int)rint(fmin(d->grain, 60));
    c->tile = (int)d->tile;
    c->corner[0] = (int)d->corner[0];
    c->corner[1] = (int)d->corner[1];
}

void plan_crops(Crop *crops, const Frame *frame, const double *center, int things, Rng *rng) {
    int64_t shown[CROPS];
    Draws *draws = memory(CROPS * sizeof *draws);
    for (int i = 0; i < CROPS; i++)
        shown[i] = i % 2;
    shuffle(rng, shown, CROPS);
    draw_all(draws, rng, frame, center, things);
    for (int i = 0; i < CROPS; i++) {
        const Draws *d = &draws[i];
        crops[i].shown = (int)shown[i];
        set_window(&crops[i], d);
        set_thing(&crops[i], d);
        set_edge(&crops[i], d);
        int thing = d->addition < (shown[i] ? 0.3 : 0.4), edge = !shown[i] && d->addition < 0.52;
        crops[i].addition = !things ? NOTHING : thing ? THING : edge ? EDGE : NOTHING;
    }
    free(draws);
}
