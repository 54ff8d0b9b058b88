/* A run: crops, features of the frozen layers, labels, steps with synthetic gradients. */
#include "graph.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { SLICE = 8 };

static const ONNXTensorElementDataType floats = ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT;

/* Between network.onnx, (out, into, rows, columns), and a step, (out, rows * columns * into). */
static void copy_weight(const Layer *layer, uint8_t *network, float *step, int back) {
    size_t positions = (size_t)layer->rows * (size_t)layer->columns, into = (size_t)layer->into;
    for (size_t o = 0; o < (size_t)layer->out; o++)
        for (size_t i = 0; i < into; i++)
            for (size_t p = 0; p < positions; p++) {
                uint8_t *there = network + layer->weight_offset + ((o * into + i) * positions + p) * 4;
                float *here = step + (o * positions + p) * into + i;
                memcpy(back ? (void *)there : here, back ? (void *)here : there, 4);
            }
}

/* Give the tuned layers' weights and biases to a graph (their places in network.onnx if `back`). */
static void copy_weights(const Bundle *bundle, const Graph *graph, const Tensor *values, uint8_t *network, int back) {
    for (int k = 0; k < 2 * bundle->count; k++) {
        const Layer *layer = &bundle->layers[k / 2];
        size_t size = (size_t)layer->out * (k % 2 ? 1 : layer->columns_in_all);
        char name[32];
        snprintf(name, sizeof name, "%s%d", k % 2 ? "bias" : "weight", bundle->first + k / 2);
        int64_t at = find_value(graph->in, graph->inputs, name);
        if (at < 0 || values[at].count != size || !values[at].data)
            fail("%s takes another %s than the bundle has: get it anew", graph->path, name);
        uint8_t *there = network + layer->bias_offset;
        if (k % 2)
            memcpy(back ? (void *)there : values[at].data, back ? values[at].data : (void *)there, size * 4);
        else
            copy_weight(layer, network, values[at].data, back);
    }
}

/* The frozen layers' features of all crops, which never exist all at once. */
static Tensor make_features(const Bundle *bundle, const Crop *crops, const Frame *frame, const Thing *things) {
    Graph trunk = open_graph(bundle->parts[TRUNK].path, NULL);
    const int64_t shape[] = {SLICE, SIDE, SIDE, 3};
    const size_t crop_bytes = SIDE * SIDE * 3;
    uint8_t *cut = memory(SLICE * crop_bytes), *all = NULL;
    Tensor samples = tensor(cut, ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8, 4, shape), features = {0};
    if (trunk.inputs != 1 || trunk.outputs != 1)
        fail("%s is no graph of frozen layers: get the bundle anew", trunk.path);
    for (int first = 0; first < CROPS; first += SLICE) {
        OrtValue *made = NULL;
        for (int i = 0; i < SLICE; i++)
            cut_crop(&crops[first + i], frame, things, cut + (size_t)i * crop_bytes);
        run_graph(&trunk, &samples.value, &made);
        Tensor slice = contents(&trunk, made, 3);
        size_t bytes = slice.count * (slice.type == floats ? 4 : 1);
        if (slice.shape[0] != SLICE || (first && (slice.count != features.count || slice.type != features.type)))
            fail("%s gives other features than those of %d crops: get it anew", trunk.path, SLICE);
        if (!all)
            all = memory(bytes * (CROPS / SLICE));
        memcpy(all + (size_t)(first / SLICE) * bytes, slice.data, bytes);
        features = slice;
        release(made);
    }
    release(samples.value);
    free(cut);
    close_graph(&trunk);
    const int64_t whole[] = {CROPS, features.shape[1], features.shape[2]};
    return tensor(all, features.type, 3, whole);
}

typedef struct {
    Graph graph;
    Tensor values[MOST_VALUES];
} Head;

static Head open_head(const Bundle *bundle) {
    Head head = {.graph = open_graph(bundle->parts[HEAD].path, NULL)};
    for (size_t i = 0; i < head.graph.inputs; i++)
        if (strcmp(head.graph.in[i], "features"))
            head.values[i] = state_of(&head.graph, head.graph.in[i]);
    if (head.graph.outputs != 1 || find_value(head.graph.in, head.graph.inputs, "features") < 0)
        fail("%s is no graph of tuned layers: get the bundle anew", head.graph.path);
    return head;
}

/* Quality, sine and cosine of all crops, as the tuned layers see them with these weights. */
static void see(Head *head, const Bundle *bundle, const Tensor *features, uint8_t *network, float *outputs) {
    const int64_t shape[] = {SLICE, features->shape[1], features->shape[2]};
    size_t bytes = features->count / CROPS * SLICE * (features->type == floats ? 4 : 1);
    int64_t place = find_value(head->graph.in, head->graph.inputs, "features");
    copy_weights(bundle, &head->graph, head->values, network, 0);
    for (int first = 0; first < CROPS; first += SLICE) {
        OrtValue *in[MOST_VALUES], *made = NULL;
        for (size_t i = 0; i < head->graph.inputs; i++)
            in[i] = head->values[i].value;
        Tensor slice = tensor((uint8_t *)features->data + (size_t)(first / SLICE) * bytes, features->type, 3, shape);
        in[place] = slice.value;
        run_graph(&head->graph, in, &made);
        Tensor seen = contents(&head->graph, made, 2);
        if (seen.type != floats || seen.count != SLICE * LABELS || seen.shape[0] != SLICE)
            fail("%s gives no 3 numbers a crop: get the bundle anew", head->graph.path);
        memcpy(outputs + first * LABELS, seen.data, SLICE * LABELS * sizeof *outputs);
        release(made);
        release(slice.value);
    }
}

/* How the demonstration lies, as the untouched network sees it; labels that angles are shifted by. */
static double make_labels(const Crop *crops, const float *outputs, int doubled, float *labels) {
    double sum[2] = {0}, count = 0;
    for (int i = 0; i < TAUGHT; i++)
        if (crops[i].shown) {
            const float *seen = outputs + i * LABELS;
            double lying = decoded(seen[1], seen[2], doubled) - (double)crops[i].turn;
            sum[0] += cos(2 * lying);
            sum[1] += sin(2 * lying);
            count++;
        }
    double offset = half_turn(atan2(sum[1] / count, sum[0] / count) / 2);
    for (int i = 0; i < CROPS; i++) {
        double angle = half_turn(crops[i].turn + (float)offset) * (doubled ? 2 : 1);
        labels[i * LABELS] = (float)crops[i].shown;
        labels[i * LABELS + 1] = crops[i].shown ? (float)sin(angle) : 0;
        labels[i * LABELS + 2] = crops[i].shown ? (float)cos(angle) : 0;
    }
    return offset;
}

/* Share of the crops that taught nothing in which the object is found or not as it should be. */
static double detection(const Crop *crops, const float *outputs) {
    int right = 0;
    for (int i = TAUGHT; i < CROPS; i++)
        right += (outputs[i * LABELS] > 0.5f) == crops[i].shown;
    return (double)right / (CROPS - TAUGHT);
}

typedef struct {
    Graph graph;
    Tensor state[2][MOST_VALUES]; /* a step reads one set and writes the other */
    OrtValue *in[2][MOST_VALUES], *out[2][MOST_VALUES];
    int64_t rows[BATCH];
    float rates[MOST_LAYERS], loss;
} Loop;

static void bind_inputs(Loop *loop, const Bundle *bundle, OrtValue *features, OrtValue *labels) {
    Graph *graph = &loop->graph;
    const int64_t batch = BATCH;
    for (size_t i = 0; i < graph->inputs; i++) {
        char next[128];
        int layer = 0;
        const char *name = graph->in[i];
        snprintf(next, sizeof next, "%s_next", name);
        OrtValue *value = !strcmp(name, "features") ? features : !strcmp(name, "labels") ? labels : NULL;
        if (!strcmp(name, "rows"))
            value = tensor(loop->rows, ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64, 1, &batch).value;
        else if (sscanf(name, "rate%2d", &layer) == 1 && layer >= bundle->first && layer < bundle->first + bundle->count)
            value = tensor(&loop->rates[layer - bundle->first], floats, 0, NULL).value;
        for (int set = 0; set < 2; set++) {
            if (!value)
                loop->state[set][i] = state_of(graph, name);
            loop->in[set][i] = value ? value : loop->state[set][i].value;
        }
        if (!value && find_value(graph->out, graph->outputs, next) < 0)
            fail("%s takes %.60s, which no step does: get the bundle anew", graph->path, name);
    }
}

static void bind_outputs(Loop *loop) {
    Graph *graph = &loop->graph;
    for (size_t i = 0; i < graph->outputs; i++) {
        char name[128] = "";
        size_t length = strlen(graph->out[i]);
        if (length > 5 && length < sizeof name && !strcmp(graph->out[i] + length - 5, "_next"))
            memcpy(name, graph->out[i], length - 5);
        int64_t from = find_value(graph->in, graph->inputs, name);
        int is_loss = !strcmp(graph->out[i], "loss");
        if (!is_loss && (from < 0 || !loop->state[0][from].value))
            fail("%s gives %.60s, which no step does: get the bundle anew", graph->path, graph->out[i]);
        OrtValue *loss = is_loss ? tensor(&loop->loss, floats, 0, NULL).value : NULL;
        for (int set = 0; set < 2; set++)
            loop->out[set][i] = is_loss ? loss : loop->state[1 - set][from].value;
    }
}

static void close_loop(Loop *loop) {
    for (size_t i = 0; i < loop->graph.inputs; i++)
        for (int set = 0; set < 2; set++) {
            free(loop->state[set][i].data);
            if (loop->state[set][i].value)
                release(loop->state[set][i].value);
            else if (set && strcmp(loop->graph.in[i], "features") && strcmp(loop->graph.in[i], "labels"))
                release(loop->in[set][i]);
        }
    release(loop->out[0][find_value(loop->graph.out, loop->graph.outputs, "loss")]);
    close_graph(&loop->graph);
    free(loop);
}

static void train(const Bundle *bundle, const Settings *set, Tensor features, Tensor labels, uint8_t *network) {
    Loop *loop = memory(sizeof *loop);
    int steps = set->epochs * (TAUGHT / BATCH), done = 0;
    double shortness = steps ? log(500.0 / steps) / log(500.0 / 75) : 1;
    double gain = pow(bundle->short_gain, fmin(1, fmax(0, shortness)));
    const uint32_t entropy[] = {set->seed, 1};
    int64_t order[TAUGHT];
    Rng rng;
    loop->graph = open_graph(bundle->parts[set->int8 ? STEP_INT8 : STEP_FLOAT].path, NULL);
    bind_inputs(loop, bundle, features.value, labels.value);
    bind_outputs(loop);
    if (find_value(loop->graph.out, loop->graph.outputs, "loss") < 0)
        fail("%s gives no loss: get the bundle anew", loop->graph.path);
    copy_weights(bundle, &loop->graph, loop->state[0], network, 0);
    rng_seed(&rng, entropy, 2);
    for (int epoch = 0; epoch < set->epochs; epoch++) {
        double sum = 0;
        for (int i = 0; i < TAUGHT; i++)
            order[i] = i;
        shuffle(&rng, order, TAUGHT);
        for (int first = 0; first < TAUGHT; first += BATCH, done++) {
            memcpy(loop->rows, order + first, sizeof loop->rows);
            for (int k = 0; k < bundle->count; k++)
                loop->rates[k] = (float)((1.0 - (double)done / steps) * (gain * bundle->rates[k]));
            run_graph(&loop->graph, loop->in[done % 2], loop->out[done % 2]);
            sum += (double)loop->loss;
            if (!isfinite(loop->loss))
                fail("tuning diverged: the loss is not finite at step %d; nothing was written", done + 1);
        }
        printf("epoch %d loss %.6f\n", epoch + 1, sum / (TAUGHT / BATCH));
    }
    copy_weights(bundle, &loop->graph, loop->state[done % 2], network, 1);
    close_loop(loop);
}

Object finetune(Bundle *bundle, const Frame *frame, const double *center, const Settings *set) {
    Crop *crops = memory(CROPS * sizeof *crops);
    float *outputs = memory(CROPS * LABELS * sizeof *outputs), *numbers = memory(CROPS * LABELS * sizeof *numbers);
    const int64_t shape[] = {CROPS, LABELS};
    Thing *things = NULL;
    Rng rng;
    int count = *bundle->parts[THINGS].path ? read_things(&bundle->parts[THINGS].file, &things) : 0;
    rng_seed(&rng, &set->seed, 1);
    plan_crops(crops, frame, center, count, &rng);
    Tensor features = make_features(bundle, crops, frame, things);
    free(things);
    Object object = {.doubled = bundle->doubled, .network = bundle->parts[NETWORK].file};
    Head head = open_head(bundle);
    see(&head, bundle, &features, object.network.bytes, outputs);
    object.offset_rad = make_labels(crops, outputs, bundle->doubled, numbers);
    double before = detection(crops, outputs);
    Tensor labels = tensor(numbers, floats, 2, shape);
    train(bundle, set, features, labels, object.network.bytes);
    see(&head, bundle, &features, object.network.bytes, outputs);
    printf("detection %.3f before %.3f\n", detection(crops, outputs), before);
    for (int i = 0; i < CROPS * LABELS; i++)
        if (!isfinite(outputs[i]) || !isfinite(object.offset_rad))
            fail("tuning diverged: a weight is not finite; nothing was written");
    for (size_t i = 0; i < head.graph.inputs; i++)
        if (head.values[i].value)
            free(head.values[i].data), release(head.values[i].value);
    close_graph(&head.graph);
    release(features.value), release(labels.value);
    free(features.data), free(outputs), free(numbers), free(crops);
    return object;
}
