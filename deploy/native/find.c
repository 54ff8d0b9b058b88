/* Where an object is in a frame: the network's own answer, as for objects without a patch. */
#include "graph.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { CELL = 16, FINE = 4, REACH = 32, FINE_SIDE = SIDE + 2 * REACH };

static const double least_weight = 1e-9;

double half_turn(double angle) { /* in (-90, 90] degrees */
    double rest = fmod(PI / 2 - angle, PI);
    rest = PI / 2 - (rest < 0 ? rest + PI : rest);
    return rest <= -PI / 2 ? PI / 2 : rest;
}

double decoded(double sine, double cosine, int doubled) {
    return half_turn(atan2(sine, cosine) / (doubled ? 2 : 1));
}

typedef struct {
    OrtValue *value;
    const float *quality, *sine, *cosine;
    int rows, columns;
} Heatmap;

/* Of a part of a frame; a cell for every window of 128 px, 16 px apart. */
static Heatmap heatmap_of(const Graph *graph, const Frame *frame, int left, int top, int width, int height) {
    const int64_t shape[] = {height, width, 3};
    uint8_t *part = memory((size_t)width * (size_t)height * 3), *at = part;
    for (int y = top; y < top + height; y++)
        for (int x = left; x < left + width; x++, at += 3)
            memcpy(at, frame->pixels + ((size_t)y * (size_t)frame->width + (size_t)x) * 4, 3);
    Tensor input = tensor(part, ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8, 3, shape);
    OrtValue *made = NULL;
    run_graph(graph, &input.value, &made);
    release(input.value);
    free(part);
    Tensor map = contents(graph, made, 3);
    int rows = 1 + (height - SIDE) / CELL, columns = 1 + (width - SIDE) / CELL, sane = map.type == ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT;
    sane = sane && map.shape[0] == 3 && (map.shape[1] == rows || map.shape[1] == rows + 1) &&
           (map.shape[2] == columns || map.shape[2] == columns + 1);
    const float *values = map.data;
    for (size_t i = 0; sane && i < map.count; i++)
        sane = isfinite(values[i]) && (i >= map.count / 3 || (values[i] >= 0 && values[i] <= 1));
    if (!sane)
        fail("%s gives no heatmap of the frame: tune the object again", graph->path);
    return (Heatmap){made, values, values + map.count / 3, values + map.count / 3 * 2, (int)map.shape[1], (int)map.shape[2]};
}

/* The middle of the strongest blob: of cells nearly as good as the best, the best supported. */
static void find_peak(const Heatmap *map, int *row, int *column) {
    double best = 0, most = -2;
    for (int i = 0; i < map->rows * map->columns; i++)
        best = fmax(best, (double)map->quality[i]);
    for (int i = 0; i < map->rows * map->columns; i++) {
        double support = 0;
        for (int n = 0; n < 9; n++) {
            int y = i / map->columns + n / 3 - 1, x = i % map->columns + n % 3 - 1;
            y = y < 0 ? 0 : y < map->rows ? y : map->rows - 1;
            x = x < 0 ? 0 : x < map->columns ? x : map->columns - 1;
            support += (double)map->quality[y * map->columns + x] * (n / 3 == 1 ? 2 : 1) * (n % 3 == 1 ? 2 : 1);
        }
        if ((double)map->quality[i] >= 0.9 * best && support > most)
            most = support, *row = i / map->columns, *column = i % map->columns;
    }
}

static Place coarse_place(const Heatmap *map, const Object *object) {
    int row = 0, column = 0;
    double sum = 0, x = 0, y = 0, sine = 0, cosine = 0;
    Place place = {0};
    find_peak(map, &row, &column);
    for (int n = 0; n < 9; n++) {
        int r = row + n / 3 - 1, c = column + n % 3 - 1, at = r * map->columns + c;
        if (r < 0 || c < 0 || r >= map->rows || c >= map->columns)
            continue;
        double weight = (double)map->quality[at] + least_weight;
        sum += weight, x += weight * c, y += weight * r;
        sine += weight * (double)map->sine[at], cosine += weight * (double)map->cosine[at];
        place.quality = fmax(place.quality, (double)map->quality[at]);
    }
    place.x = HALF + CELL * x / sum;
    place.y = HALF + CELL * y / sum;
    place.turn = decoded(sine / sum, cosine / sum, object->doubled);
    return place;
}

typedef struct {
    double quality, sine, cosine, x, y;
} Cell;

/* Windows 4 px apart around a place: sixteen small heatmaps, each shifted. */
static int fine_cells(const Graph *graph, const Frame *frame, const Place *place, Cell *cells) {
    const double center[2] = {place->x, place->y};
    const int sizes[2] = {frame->width, frame->height};
    int corner[2], count = 0;
    for (int k = 0; k < 2; k++) {
        int first = (int)rint(center[k]) - REACH - HALF, last = sizes[k] - FINE_SIDE;
        corner[k] = first < last ? first : last;
        corner[k] = corner[k] > 0 ? corner[k] : 0;
    }
    for (int n = 0; n < 16; n++) {
        int left = corner[0] + n % 4 * FINE, top = corner[1] + n / 4 * FINE, side = FINE_SIDE - CELL;
        int width = frame->width - left < side ? frame->width - left : side;
        int height = frame->height - top < side ? frame->height - top : side;
        if (width < SIDE || height < SIDE)
            continue;
        Heatmap map = heatmap_of(graph, frame, left, top, width, height);
        for (int i = 0; i < map.rows * map.columns; i++)
            cells[count++] = (Cell){map.quality[i], map.sine[i], map.cosine[i],
                                    left + HALF + CELL * (i % map.columns), top + HALF + CELL * (i / map.columns)};
        release(map.value);
    }
    return count;
}

/* The centre is the middle of the better half of those windows, the turn that of the nearest. */
static void refine(const Graph *graph, const Frame *frame, const Object *object, Place *place) {
    Cell cells[16 * 36];
    int count = fine_cells(graph, frame, place, cells);
    double best = 0, sum = 0, x = 0, y = 0, sine = 0, cosine = 0;
    for (const Cell *c = cells; c < cells + count; c++)
        best = fmax(best, c->quality);
    for (const Cell *c = cells; c < cells + count; c++) {
        double weight = fmax(c->quality - best / 2, 0) + least_weight;
        sum += weight, x += weight * c->x, y += weight * c->y;
    }
    place->x = x / sum;
    place->y = y / sum;
    for (const Cell *c = cells; c < cells + count; c++) {
        double right = c->x - place->x, down = c->y - place->y, near = exp(-0.5 * (right * right + down * down) / 16);
        sine += near * c->sine, cosine += near * c->cosine;
    }
    place->turn = decoded(sine, cosine, object->doubled);
}

Place find_object(const Object *object, const Frame *frame, const char *path) {
    Graph graph = open_graph(path, &object->network);
    if (graph.inputs != 1 || graph.outputs != 1)
        fail("%s is no network from a frame to a heatmap: tune the object again", path);
    Heatmap map = heatmap_of(&graph, frame, 0, 0, frame->width, frame->height);
    Place place = coarse_place(&map, object);
    release(map.value);
    place.found = place.quality >= 0.5;
    if (place.found)
        refine(&graph, frame, object, &place);
    place.turn = half_turn(place.turn - object->offset_rad) * 180 / PI;
    close_graph(&graph);
    return place;
}
