/* Cutting planned crops out of a frame, with what lies on them, byte for byte as docs/bundle.md has
   it. Compile with -ffp-contract=off: what is rounded where matters. */
#include "qsgm.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { GRAIN_SIDE = 192 };

typedef struct {
    int left, top, right, bottom; /* the last two outside */
} Box;

static Box box_around(double x, double y, double half_x, double half_y) {
    return (Box){(int)fmax(floor(x - half_x), 0), (int)fmax(floor(y - half_y), 0),
                 (int)fmin(ceil(x + half_x) + 1, SIDE), (int)fmin(ceil(y + half_y) + 1, SIDE)};
}

static int in_box(Box box, int x, int y) {
    return x >= box.left && x < box.right && y >= box.top && y < box.bottom;
}

static uint8_t share(int a, int b) { return (uint8_t)((a * b + 127) / 255); }

static uint8_t byte(int value) { return (uint8_t)(value < 0 ? 0 : value > 255 ? 255 : value); }

static int mirrored(int at, int size) {
    while (at < 0 || at >= size)
        at = at < 0 ? -at : 2 * size - 2 - at;
    return at;
}

static int floored(float value) { return (int)value - (value < (float)(int)value); }

/* Of 0 to 255, half to even: beside 2^23 there is no room for a fraction. */
static uint8_t nearest(float value) { return (uint8_t)(value + 8388608.0f - 8388608.0f); }

/* a * b + c, rounded to float32 once. */
static float fused(float a, float b, float c) {
#ifdef FP_FAST_FMAF
    return fmaf(a, b, c);
#else
    return (float)((double)a * (double)b + (double)c);
#endif
}

/* The pixel of a frame, or beyond its border that of its mirror image; `empty`: none. */
static const uint8_t *pixel_at(const Frame *frame, int empty, int x, int y) {
    static const uint8_t nothing[4];
    int outside = x < 0 || y < 0 || x >= frame->width || y >= frame->height;
    if (outside && empty)
        return nothing;
    if (outside) {
        x = mirrored(x, frame->width);
        y = mirrored(y, frame->height);
    }
    return frame->pixels + ((size_t)y * (size_t)frame->width + (size_t)x) * 4;
}

/* Fill a box of a crop with what an affine map of its pixels leads to in a frame. */
static void warp(const Frame *frame, int empty, const float *map, Box box, uint8_t *out) {
    for (int i = box.top; i < box.bottom; i++)
        for (int k = box.left; k < box.right; k++) {
            float across = (float)(k - box.left), down = (float)(i - box.top);
            float place_x = fused(map[0], across, map[1] * down + map[2]);
            float place_y = fused(map[3], across, map[4] * down + map[5]);
            int left = floored(place_x), top = floored(place_y);
            float x = place_x - (float)left, y = place_y - (float)top;
            const uint8_t *corner[4];
            for (int n = 0; n < 4; n++)
                corner[n] = pixel_at(frame, empty, left + n % 2, top + n / 2);
            for (int n = 0; n < 4; n++) {
                float above = corner[0][n], below = corner[2][n];
                above = fused(x, corner[1][n] - above, above);
                below = fused(x, corner[3][n] - below, below);
                out[(i * SIDE + k) * 4 + n] = nearest(fused(y, below - above, above));
            }
        }
}

/* The thing as it lies over the crop, its colours times their gains; all but the box is empty. */
static Box lay_thing(const Crop *c, const Thing *thing, uint8_t *layer) {
    double cosine = cos((double)c->thing_turn), sine = sin((double)c->thing_turn), scale = c->scale;
    double x = c->middle[0], y = c->middle[1], wide = fabs(scale * cosine), tall = fabs(scale * sine);
    Box box = box_around(x, y, wide * thing->reach[0] + tall * thing->reach[1] + 1,
                         tall * thing->reach[0] + wide * thing->reach[1] + 1);
    uint8_t lit[SIDE * SIDE * 4];
    for (int i = 0; i < SIDE * SIDE * 4; i++) {
        int value = thing->pixels[i];
        lit[i] = i % 4 == 3 ? (uint8_t)value : byte((value * c->gain[i % 4] + 128) >> 8);
    }
    cosine /= scale, sine /= scale, x -= box.left, y -= box.top;
    const double middle = (SIDE - 1) / 2.0;
    const float map[6] = {(float)cosine, (float)-sine, (float)(middle - cosine * x + sine * y),
                          (float)sine, (float)cosine, (float)(middle - sine * x - cosine * y)};
    const Frame tile = {SIDE, SIDE, lit};
    memset(layer, 0, SIDE * SIDE * 4);
    warp(&tile, 1, map, box, layer);
    return box;
}

/* Opacity of a layer averaged over squares of twice the radius and one; nothing lies outside. */
static void blur(const uint8_t *layer, int radius, uint8_t *soft) {
    static const int stride = SIDE + 1;
    int sums[(SIDE + 1) * (SIDE + 1)] = {0}, area = (2 * radius + 1) * (2 * radius + 1);
    for (int y = 0; y < SIDE; y++)
        for (int x = 0, row = 0; x < SIDE; x++) {
            row += layer[(y * SIDE + x) * 4 + 3];
            sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + row;
        }
    for (int y = 0; y < SIDE; y++)
        for (int x = 0; x < SIDE; x++) {
            int left = x < radius ? 0 : x - radius, right = x + radius < SIDE ? x + radius + 1 : SIDE;
            int top = y < radius ? 0 : y - radius, bottom = y + radius < SIDE ? y + radius + 1 : SIDE;
            int sum = sums[bottom * stride + right] - sums[top * stride + right] -
                      sums[bottom * stride + left] + sums[top * stride + left];
            soft[y * SIDE + x] = (uint8_t)((2 * sum + area) / (2 * area));
        }
}

static void paste(uint8_t *crop, const Crop *c, const Thing *thing) {
    uint8_t layer[SIDE * SIDE * 4], soft[SIDE * SIDE];
    Box box = lay_thing(c, thing, layer);
    int x = c->shadow[0], y = c->shadow[1];
    int reach = (abs(x) > abs(y) ? abs(x) : abs(y)) + c->shadow_radius;
    Box whole = {box.left - reach, box.top - reach, box.right + reach, box.bottom + reach};
    if (box.left >= box.right || box.top >= box.bottom)
        return;
    blur(layer, c->shadow_radius, soft);
    for (int row = 0; row < SIDE; row++)
        for (int column = 0; column < SIDE; column++) {
            int from_x = column - x, from_y = row - y, at = row * SIDE + column, light = 255;
            int shadowed = from_x >= 0 && from_y >= 0 && from_x < SIDE && from_y < SIDE;
            if (shadowed && in_box(whole, column, row) && in_box(whole, from_x, from_y))
                light -= share(c->shadow_strength, soft[from_y * SIDE + from_x]);
            if (in_box(box, column, row))
                light = share(light, 255 - layer[at * 4 + 3]);
            for (int k = 0; k < 3; k++)
                crop[at * 4 + k] = byte(share(crop[at * 4 + k], light) + layer[at * 4 + k]);
        }
}

/* Noise about 128: a byte of a hash of each pixel's number (Wellons' lowbias32), or four times the
   mean of such bytes around it. */
static int grain(int tile, int x, int y) {
    int total = 0, reach = tile ? 2 : 0;
    for (int down = -reach; down <= reach; down++)
        for (int right = -reach; right <= reach; right++) {
            uint32_t number = (uint32_t)((y + down + GRAIN_SIDE) % GRAIN_SIDE * GRAIN_SIDE +
                                         (x + right + GRAIN_SIDE) % GRAIN_SIDE);
            number = (number ^ number >> 16) * 0x7feb352du;
            number = (number ^ number >> 15) * 0x846ca68bu;
            total += (number ^ number >> 16) & 255;
        }
    if (!tile)
        return total;
    int four = (total - 25 * 128) * 4;
    return byte(128 + (four < 0 ? -((-four + 24) / 25) : four / 25));
}

static void paint_edge(uint8_t *crop, const Crop *c) {
    for (int y = 0; y < SIDE; y++)
        for (int x = 0; x < SIDE; x++) {
            int least = 255 << 8;
            for (int i = 0; i < 4; i++) {
                int here = c->planes[i][0] * x + c->planes[i][1] * y + c->planes[i][2];
                least = here < least ? here : least;
            }
            int covered = least < 0 ? 0 : least >> 8;
            int bump = (grain(c->tile, x + c->corner[0], y + c->corner[1]) - 128) * c->grain;
            for (int k = 0; k < 3; k++) {
                uint8_t *at = crop + (y * SIDE + x) * 4 + k, surface = byte(c->surface[k] + (bump >> 7));
                *at = byte(share(surface, covered) + share(*at, 255 - covered));
            }
        }
}

void cut_crop(const Crop *c, const Frame *frame, const Thing *things, uint8_t *crop) {
    uint8_t wide[SIDE * SIDE * 4];
    warp(frame, 0, c->map, (Box){0, 0, SIDE, SIDE}, wide);
    if (c->addition == THING)
        paste(wide, c, &things[c->thing]);
    else if (c->addition == EDGE)
        paint_edge(wide, c);
    for (int i = 0; i < SIDE * SIDE; i++)
        for (int k = 0; k < 3; k++) {
            const int *mix = c->color[k], *pixel = (const int[]){wide[4 * i], wide[4 * i + 1], wide[4 * i + 2]};
            crop[3 * i + k] = byte((mix[0] * pixel[0] + mix[1] * pixel[1] + mix[2] * pixel[2] + mix[3]) >> 10);
        }
}
