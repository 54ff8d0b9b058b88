#define _XOPEN_SOURCE 700
#include "graph.h"

#include <stdlib.h>
#include <string.h>

static const OrtApi *ort;
static OrtEnv *environment;

/* Ends the program where ONNX Runtime refuses something. */
static void check(OrtStatus *status, const char *path) {
    if (status)
        fail("ONNX Runtime refuses %s: %.300s", path, ort->GetErrorMessage(status));
}

static void start(void) {
    setenv("ORT_DISABLE_TELEMETRY", "1", 0);
    ort = OrtGetApiBase()->GetApi(17);
    if (!ort)
        fail("ONNX Runtime %s is too old: expected 1.17 or later", OrtGetApiBase()->GetVersionString());
    check(ort->CreateEnv(ORT_LOGGING_LEVEL_FATAL, "qsgm", &environment), "to start");
}

static char *name_at(const Graph *graph, size_t index, int input) {
    OrtAllocator *allocator;
    char *name;
    check(ort->GetAllocatorWithDefaultOptions(&allocator), graph->path);
    check(input ? ort->SessionGetInputName(graph->session, index, allocator, &name)
                : ort->SessionGetOutputName(graph->session, index, allocator, &name), graph->path);
    return name;
}

Graph open_graph(const char *path, const File *bytes) {
    Graph graph = {.path = path};
    OrtSessionOptions *options;
    if (!ort)
        start();
    check(ort->CreateSessionOptions(&options), path);
    check(ort->SetIntraOpNumThreads(options, 1), path);
    check(ort->SetInterOpNumThreads(options, 1), path);
    check(bytes ? ort->CreateSessionFromArray(environment, bytes->bytes, bytes->size, options, &graph.session)
                : ort->CreateSession(environment, path, options, &graph.session), path);
    ort->ReleaseSessionOptions(options);
    check(ort->SessionGetInputCount(graph.session, &graph.inputs), path);
    check(ort->SessionGetOutputCount(graph.session, &graph.outputs), path);
    if (graph.inputs > MOST_VALUES || graph.outputs > MOST_VALUES)
        fail("%s takes %zu and gives %zu values: expected %d at most", path, graph.inputs, graph.outputs, MOST_VALUES);
    for (size_t i = 0; i < graph.inputs; i++)
        graph.in[i] = name_at(&graph, i, 1);
    for (size_t i = 0; i < graph.outputs; i++)
        graph.out[i] = name_at(&graph, i, 0);
    return graph;
}

void close_graph(Graph *graph) {
    OrtAllocator *allocator;
    check(ort->GetAllocatorWithDefaultOptions(&allocator), graph->path);
    for (size_t i = 0; i < graph->inputs; i++)
        check(ort->AllocatorFree(allocator, graph->in[i]), graph->path);
    for (size_t i = 0; i < graph->outputs; i++)
        check(ort->AllocatorFree(allocator, graph->out[i]), graph->path);
    ort->ReleaseSession(graph->session);
}

static size_t bytes_of(ONNXTensorElementDataType type) {
    return type == ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8 ? 1 : type == ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64 ? 8 : 4;
}

Tensor tensor(void *data, ONNXTensorElementDataType type, size_t rank, const int64_t *shape) {
    OrtMemoryInfo *where;
    Tensor made = {.type = type, .rank = rank, .count = 1, .data = data};
    for (size_t i = 0; i < rank; i++)
        made.shape[i] = shape[i], made.count *= (size_t)shape[i];
    check(ort->CreateCpuMemoryInfo(OrtArenaAllocator, OrtMemTypeDefault, &where), "memory");
    check(ort->CreateTensorWithDataAsOrtValue(where, data, made.count * bytes_of(type), shape, rank, type, &made.value), "memory");
    ort->ReleaseMemoryInfo(where);
    return made;
}

/* Type and shape of a tensor; refused unless float or bytes, of rank 4 at most and not huge. */
static Tensor described(const char *path, const OrtTensorTypeAndShapeInfo *about) {
    Tensor found = {.count = 1};
    check(ort->GetTensorElementType(about, &found.type), path);
    check(ort->GetDimensionsCount(about, &found.rank), path);
    int sane = found.rank <= 4 && (found.type == ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT || found.type == ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8);
    if (sane)
        check(ort->GetDimensions(about, found.shape, found.rank), path);
    for (size_t i = 0; sane && i < found.rank; i++) {
        sane = found.shape[i] > 0 && found.shape[i] < 1 << 24 && found.count < 1 << 24;
        found.count *= sane ? (size_t)found.shape[i] : 1;
    }
    if (!sane)
        fail("%s has values that a graph of this kind has not: get it anew", path);
    return found;
}

Tensor state_of(const Graph *graph, const char *input) {
    OrtTypeInfo *info;
    const OrtTensorTypeAndShapeInfo *about;
    size_t index = (size_t)find_value(graph->in, graph->inputs, input);
    check(ort->SessionGetInputTypeInfo(graph->session, index, &info), graph->path);
    check(ort->CastTypeInfoToTensorInfo(info, &about), graph->path);
    if (!about)
        fail("%s takes something else than a tensor: get it anew", graph->path);
    Tensor found = described(graph->path, about);
    ort->ReleaseTypeInfo(info);
    if (found.type != ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT)
        fail("%s keeps something else than numbers in %s: get it anew", graph->path, input);
    return tensor(memory(found.count * 4), found.type, found.rank, found.shape);
}

int64_t find_value(char *const *names, size_t count, const char *name) {
    for (size_t i = 0; i < count; i++)
        if (!strcmp(names[i], name))
            return (int64_t)i;
    return -1;
}

void run_graph(const Graph *graph, OrtValue *const *in, OrtValue **out) {
    check(ort->Run(graph->session, NULL, (const char *const *)graph->in, (const OrtValue *const *)in,
                   graph->inputs, (const char *const *)graph->out, graph->outputs, out), graph->path);
}

Tensor contents(const Graph *graph, OrtValue *value, size_t rank) {
    OrtTensorTypeAndShapeInfo *about;
    int is_tensor = 0;
    check(ort->IsTensor(value, &is_tensor), graph->path);
    if (!is_tensor)
        fail("%s gives something else than a tensor: get it anew", graph->path);
    check(ort->GetTensorTypeAndShape(value, &about), graph->path);
    Tensor found = described(graph->path, about);
    ort->ReleaseTensorTypeAndShapeInfo(about);
    if (found.rank != rank)
        fail("%s gives %zu dimensions: expected %zu; get it anew", graph->path, found.rank, rank);
    found.value = value;
    check(ort->GetTensorMutableData(value, &found.data), graph->path);
    return found;
}

void release(OrtValue *value) { ort->ReleaseValue(value); }
