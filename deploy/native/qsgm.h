/* Fine-tuning with synthetic gradients on the ONNX Runtime C API. README.md says what for. */
#ifndef QSGM_H
#define QSGM_H

#include <stddef.h>
#include <stdint.h>

enum { SIDE = 128, HALF = SIDE / 2, CROPS = 1000, TAUGHT = 800, BATCH = 32, LABELS = 3 };
enum { MOST_LAYERS = 6, LEAST_FRAME = 128, MOST_FRAME = 4096, PATH_BYTES = 4096 };

static const double PI = 3.14159265358979323846;

/* files.c: whatever is wrong with a file ends the program with one line. */
typedef struct {
    size_t size;
    uint8_t *bytes; /* followed by a zero */
} File;

typedef struct {
    int width, height;
    uint8_t *pixels; /* BGR and a fourth byte, row by row */
} Frame;

typedef struct { /* of a bundle */
    char name[64], path[PATH_BYTES];
    File file;
} Part;

enum { NETWORK, WEIGHTS, TRUNK, HEAD, STEP_FLOAT, STEP_INT8, THINGS, PARTS };

typedef struct { /* of the network: its weight is (out, into, rows, columns) */
    int out, into, rows, columns;
    size_t columns_in_all, weight_offset, bias_offset; /* of a step's weight; in network.onnx */
} Layer;

typedef struct {
    int first, count, doubled; /* tuned layers; whether labels hold the angle twice */
    double rates[MOST_LAYERS], short_gain;
    Layer layers[MOST_LAYERS];
    Part parts[PARTS]; /* things: none where its path is empty */
} Bundle;

typedef struct {
    int doubled;
    double offset_rad;
    File network;
} Object;

_Noreturn void fail(const char *format, ...) __attribute__((format(printf, 1, 2)));
void *memory(size_t bytes); /* zeros */
void join(char *path, const char *folder, const char *name);
File read_file(const char *path);
Frame read_frame(const char *path, const char *raw_size);
Bundle read_bundle(const char *folder);
Object read_object(const char *folder);
void check_new(const char *folder);
void write_object(const char *folder, const char *name, const Object *object);

typedef struct { /* one that is not the object */
    int reach[2]; /* of its visible pixels, from the middle [px] */
    uint8_t pixels[SIDE * SIDE * 4]; /* BGR times opacity, opacity */
} Thing;

static inline uint32_t big_endian(const uint8_t *at) {
    return (uint32_t)at[0] << 24 | (uint32_t)at[1] << 16 | (uint32_t)at[2] << 8 | at[3];
}

/* sheet.c */
int read_things(const File *file, Thing **things); /* how many */

/* rng.c */
typedef struct {
    double x[257], height[257];
} Ziggurat;

typedef struct {
    unsigned __int128 state, step;
    uint32_t half;
    int has_half;
    Ziggurat normal, exponential;
} Rng;

void rng_seed(Rng *rng, const uint32_t *entropy, int words);
double uniform(Rng *rng, double low, double high);
double integer(Rng *rng, double low, double high); /* below high */
double normal(Rng *rng, double mean, double deviation);
double exponential(Rng *rng, double low, double mean);
void shuffle(Rng *rng, int64_t *values, int count);

/* plan.c, cut.c */
enum { NOTHING, THING, EDGE };

typedef struct { /* what is to be cut; colours are blue, green, red, places x, y */
    int shown; /* whether the object is in the middle */
    float turn, map[6];
    int color[3][4]; /* 10-bit fixed point */
    int addition, thing, gain[3], shadow[2], shadow_radius, shadow_strength;
    float middle[2], thing_turn, scale;
    int planes[4][3], surface[3], grain, tile, corner[2];
} Crop;

void plan_crops(Crop *crops, const Frame *frame, const double *center, int things, Rng *rng);
void cut_crop(const Crop *crop, const Frame *frame, const Thing *things, uint8_t *pixels);

/* job.c, find.c */
typedef struct {
    int int8, epochs;
    uint32_t seed;
    const char *name;
} Settings;

typedef struct {
    int found;
    double quality, x, y, turn; /* pixels of the frame; degrees, counter-clockwise */
} Place;

Object finetune(Bundle *bundle, const Frame *frame, const double *center, const Settings *settings);
Place find_object(const Object *object, const Frame *frame, const char *path);
double half_turn(double angle);
double decoded(double sine, double cosine, int doubled);

#endif
