/* qsgm-native: teach an object on one frame, find it in another. */
#include "qsgm.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const char usage[] =
    "usage: qsgm-native finetune [--int8] [--epochs N] [--seed N] [--center X,Y] [--name NAME]\n"
    "                            [--raw WIDTHxHEIGHT] BUNDLE FRAME OBJECT\n"
    "       qsgm-native predict [--raw WIDTHxHEIGHT] OBJECT FRAME\n"
    "BUNDLE: a folder that `qsgm slim` wrote; FRAME: a PPM (P6), or raw BGR bytes; OBJECT: a folder\n";

_Noreturn static void misused(void) {
    fputs(usage, stderr);
    exit(2);
}

static double numeral(const char *text, double low, double high, char last) {
    char *end;
    double value = strtod(text, &end);
    if (end == text || *end != last || !(value >= low && value <= high))
        misused();
    return value;
}

/* A name goes into JSON as it is. */
static void check_name(const char *name) {
    size_t length = strlen(name);
    for (const char *at = name; *at; at++)
        if (*at < 32 || *at > 126 || *at == '"' || *at == '\\')
            length = 0;
    if (length < 1 || length > 200)
        fail("the name cannot be one: expected 1 to 200 plain letters, no quote or backslash");
}

static void teach(const char *folder, const Frame *frame, const double *center, const Settings *set, const char *out) {
    int sides = frame->width < frame->height ? frame->width : frame->height;
    if (sides < 2 * SIDE)
        fail("the frame is %dx%d px: expected 256 at least on each side", frame->width, frame->height);
    if (!(center[0] >= HALF && center[1] >= HALF && center[0] <= frame->width - HALF && center[1] <= frame->height - HALF))
        fail("the object's centre is closer than 64 px to the border: move the camera or pass --center");
    check_new(out);
    Bundle *bundle = memory(sizeof *bundle);
    *bundle = read_bundle(folder);
    Object object = finetune(bundle, frame, center, set);
    write_object(out, set->name, &object);
    for (int i = 0; i < PARTS; i++)
        free(bundle->parts[i].file.bytes);
    free(bundle);
}

static void look(const char *folder, const Frame *frame) {
    char path[PATH_BYTES];
    Object object = read_object(folder);
    join(path, folder, "network.onnx");
    Place place = find_object(&object, frame, path);
    printf("{\"found\": %s, \"quality\": %.4f, \"center_px\": [%.3f, %.3f], \"displacement_px\": [%.3f, %.3f], "
           "\"angle_deg\": %.3f}\n", place.found ? "true" : "false", place.quality, place.x, place.y,
           place.x - frame->width / 2.0, place.y - frame->height / 2.0, place.turn);
    free(object.network.bytes);
}

int main(int count, char **arguments) {
    Settings set = {.epochs = 10, .name = "object"};
    const char *raw_size = NULL, *middle = NULL;
    char *given[4] = {NULL};
    int known = 0;
    for (int i = 1; i < count; i++) {
        char *one = arguments[i], *value = i + 1 < count ? arguments[i + 1] : "";
        int takes_value = 1;
        if (!strcmp(one, "--int8"))
            set.int8 = 1, takes_value = 0;
        else if (!strcmp(one, "--epochs"))
            set.epochs = (int)numeral(value, 1, 1000, 0);
        else if (!strcmp(one, "--seed"))
            set.seed = (uint32_t)numeral(value, 0, 4294967295.0, 0);
        else if (!strcmp(one, "--center"))
            middle = value;
        else if (!strcmp(one, "--name"))
            set.name = value;
        else if (!strcmp(one, "--raw"))
            raw_size = value;
        else if (one[0] != '-' && known < 4)
            given[known++] = one, takes_value = 0;
        else
            misused();
        i += takes_value;
    }
    int teaching = known == 4 && !strcmp(given[0], "finetune");
    if (!teaching && !(known == 3 && !strcmp(given[0], "predict")))
        misused();
    check_name(set.name);
    if (teaching)
        for (size_t last = strlen(given[3]); last > 1 && given[3][last - 1] == '/'; last--)
            given[3][last - 1] = 0;
    Frame frame = read_frame(given[2], raw_size);
    double center[2] = {frame.width / 2.0, frame.height / 2.0};
    if (middle) {
        center[0] = numeral(middle, 0, MOST_FRAME, ',');
        center[1] = numeral(strchr(middle, ',') + 1, 0, MOST_FRAME, 0);
    }
    if (teaching)
        teach(given[1], &frame, center, &set, given[3]);
    else
        look(given[1], &frame);
    free(frame.pixels);
    if (fflush(stdout))
        fail("cannot write to the standard output");
    return 0;
}
