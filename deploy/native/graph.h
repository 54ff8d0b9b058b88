/* ONNX Runtime's C API, as far as it is needed here. */
#ifndef GRAPH_H
#define GRAPH_H

#include "qsgm.h"

#include <onnxruntime_c_api.h>

enum { MOST_VALUES = 128 };

typedef struct {
    const char *path; /* for messages */
    OrtSession *session;
    size_t inputs, outputs;
    char *in[MOST_VALUES], *out[MOST_VALUES];
} Graph;

typedef struct {
    OrtValue *value;
    ONNXTensorElementDataType type;
    int64_t shape[4];
    size_t rank, count;
    void *data;
} Tensor;

Graph open_graph(const char *path, const File *bytes); /* bytes NULL: the file itself */
void close_graph(Graph *graph);
Tensor tensor(void *data, ONNXTensorElementDataType type, size_t rank, const int64_t *shape);
Tensor state_of(const Graph *graph, const char *input); /* zeros of an input's shape */
int64_t find_value(char *const *names, size_t count, const char *name); /* -1: there is none */
/* Values by the order of the graph's names; outputs that are NULL are made. */
void run_graph(const Graph *graph, OrtValue *const *in, OrtValue **out);
Tensor contents(const Graph *graph, OrtValue *value, size_t rank);
void release(OrtValue *value);

#endif
