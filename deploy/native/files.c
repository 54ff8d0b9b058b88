/* Everything that is read or written. What is wrong with a file becomes one line. */
#define _XOPEN_SOURCE 700
#include "qsgm.h"

#include <ctype.h>
#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define BUNDLE "bundle.txt"

static const size_t most_bytes = 64000000;
static char unfinished[PATH_BYTES]; /* the folder that is being written */

void fail(const char *format, ...) {
    char line[2048];
    va_list values;
    va_start(values, format);
    vsnprintf(line, sizeof line, format, values);
    va_end(values);
    for (char *at = line; *at; at++)
        *at = (unsigned char)*at < 32 ? ' ' : *at;
    fprintf(stderr, "error: %s\n", line);
    exit(1);
}

void *memory(size_t bytes) {
    void *zeros = calloc(1, bytes ? bytes : 1);
    if (!zeros)
        fail("out of memory: %zu bytes", bytes);
    return zeros;
}

void join(char *path, const char *folder, const char *name) {
    if (snprintf(path, PATH_BYTES, "%s/%s", folder, name) >= PATH_BYTES)
        fail("the name %.60s... is too long: pass a shorter one", folder);
}

File read_file(const char *path) {
    struct stat about;
    if (stat(path, &about))
        fail("cannot read %s: %s", path, strerror(errno));
    if (!S_ISREG(about.st_mode) || (size_t)about.st_size > most_bytes)
        fail("%s is no regular file of at most %zu bytes: pass another one", path, most_bytes);
    File file = {(size_t)about.st_size, memory((size_t)about.st_size + 1)};
    FILE *stream = fopen(path, "rb");
    if (!stream || fread(file.bytes, 1, file.size, stream) != file.size)
        fail("cannot read %s: %s", path, strerror(errno));
    fclose(stream);
    return file;
}

static uint32_t turned(uint32_t value, int bits) { return value >> bits | value << (32 - bits); }

/* SHA-256 (FIPS 180-4); its constants are 32 bits behind the point of primes' roots. */
static void digest(const File *file, char *digits) {
    uint32_t state[8], constants[64];
    for (int prime = 2, found = 0; found < 64; prime++) {
        int divisor = 2;
        while (prime % divisor)
            divisor++;
        if (divisor < prime)
            continue;
        if (found < 8)
            state[found] = (uint32_t)(uint64_t)((sqrt(prime) - floor(sqrt(prime))) * 4294967296.0);
        constants[found++] = (uint32_t)(uint64_t)((cbrt(prime) - floor(cbrt(prime))) * 4294967296.0);
    }
    size_t padded = (file->size + 72) / 64 * 64;
    uint8_t *data = memory(padded);
    memcpy(data, file->bytes, file->size);
    data[file->size] = 0x80;
    for (int i = 0; i < 8; i++)
        data[padded - 1 - (size_t)i] = (uint8_t)((uint64_t)file->size * 8 >> 8 * i);
    for (const uint8_t *block = data; block < data + padded; block += 64) {
        uint32_t w[64], s[8];
        memcpy(s, state, sizeof s);
        for (int i = 0; i < 64; i++) {
            w[i] = i < 16 ? big_endian(block + 4 * i)
                          : w[i - 16] + w[i - 7] +
                                (turned(w[i - 15], 7) ^ turned(w[i - 15], 18) ^ w[i - 15] >> 3) +
                                (turned(w[i - 2], 17) ^ turned(w[i - 2], 19) ^ w[i - 2] >> 10);
            uint32_t one = s[7] + constants[i] + w[i] + ((s[4] & s[5]) ^ (~s[4] & s[6])) +
                           (turned(s[4], 6) ^ turned(s[4], 11) ^ turned(s[4], 25));
            uint32_t two = ((s[0] & s[1]) ^ (s[0] & s[2]) ^ (s[1] & s[2])) +
                           (turned(s[0], 2) ^ turned(s[0], 13) ^ turned(s[0], 22));
            memmove(s + 1, s, 7 * sizeof *s);
            s[4] += one;
            s[0] = one + two;
        }
        for (int i = 0; i < 8; i++)
            state[i] += s[i];
    }
    free(data);
    for (int i = 0; i < 8; i++)
        snprintf(digits + 8 * i, 9, "%08x", state[i]);
}

/* The next number of a PPM's header, behind blanks and comments; the file ends with a zero. */
static long header_number(const uint8_t **at) {
    for (int comment = 0; comment || isspace(**at) || **at == '#'; ++*at) {
        comment = (comment || **at == '#') && **at != '\n';
        if (!**at)
            return 0;
    }
    long value = 0;
    for (; isdigit(**at) && value < 100000; ++*at)
        value = 10 * value + **at - '0';
    return value;
}

Frame read_frame(const char *path, const char *raw_size) {
    File file = read_file(path);
    const uint8_t *at = file.bytes;
    long width = 0, height = 0, most = 255, end = 0, red_first = !raw_size;
    if (raw_size && (sscanf(raw_size, "%5ldx%5ld%ln", &width, &height, &end) != 2 || raw_size[end]))
        fail("the size %.40s is none: expected WIDTHxHEIGHT", raw_size);
    if (!raw_size) {
        if (memcmp(at, "P6", file.size < 2 ? file.size + 1 : 2))
            fail("%s is no PPM (P6): convert it, or pass --raw WIDTHxHEIGHT for raw BGR", path);
        at += 2;
        width = header_number(&at), height = header_number(&at), most = header_number(&at);
        at += isspace(*at) ? 1 : 0;
    }
    if (width < LEAST_FRAME || height < LEAST_FRAME || width > MOST_FRAME || height > MOST_FRAME ||
        most != 255)
        fail("%s has %ldx%ld px of %ld levels: expected 128 to 4096 px a side, 8 bits", path, width, height, most + 1);
    size_t pixels = (size_t)width * (size_t)height, there = file.size - (size_t)(at - file.bytes);
    if (there != pixels * 3)
        fail("%s has %zu bytes of pixels: expected %zu for %ldx%ld", path, there, pixels * 3, width, height);
    Frame frame = {(int)width, (int)height, memory(pixels * 4)};
    for (size_t i = 0; i < pixels; i++)
        for (size_t k = 0; k < 3; k++)
            frame.pixels[4 * i + k] = at[3 * i + (red_first ? 2 - k : k)];
    free(file.bytes);
    return frame;
}

/* What follows a key at the start of a line; NULL where there is none. Two are refused. */
static const char *value_of(const File *text, const char *key) {
    const char *start = (const char *)text->bytes, *found = NULL;
    for (const char *at = start; (at = strstr(at, key)); at++)
        if (at == start || at[-1] == '\n') {
            if (found)
                fail("the key %s is there twice: get the folder anew", key);
            found = at + strlen(key);
        }
    return found;
}

static double number(const char **at, const char *key, double low, double high) {
    char *end = NULL;
    double value = *at ? strtod(*at, &end) : NAN;
    if (!*at || end == *at || !strchr(" ,\n", *end) || !(value >= low && value <= high))
        fail("the key %s is missing or damaged: expected a number of %g to %g; get the folder anew", key, low, high);
    *at = end;
    return value;
}

/* Whether a text follows, up to the end of its line. */
static int says(const char *at, const char *text) {
    size_t length = strlen(text);
    return at && !strncmp(at, text, length) && strchr(",\n", at[length]);
}

static void find_part(const char *folder, const File *text, const char *key, Part *part) {
    const char *at = value_of(text, key);
    char digits[65], expected[65];
    int end = 0;
    if (!at || sscanf(at, "%64[0-9a-f] %63[A-Za-z0-9._,-]%n", expected, part->name, &end) != 2 ||
        at[end] != '\n')
        fail("%s/%s: %sis missing or damaged: make it anew with `qsgm slim`", folder, BUNDLE, key);
    join(part->path, folder, part->name);
    part->file = read_file(part->path);
    digest(&part->file, digits);
    if (strcmp(digits, expected))
        fail("%s is altered: its sha256 differs; make it anew with `qsgm slim`", part->path);
}

Bundle read_bundle(const char *folder) {
    static const char *keys[] = {"network ", "weights ", "trunk ", "head ", "step_float ", "step_int8 "};
    char path[PATH_BYTES];
    Bundle bundle = {0};
    join(path, folder, BUNDLE);
    File text = read_file(path);
    if (!says(value_of(&text, "qsgm-bundle-text "), "1") || !says(value_of(&text, "task "), "grasp"))
        fail("%s is of another version or task: make it with this version's `qsgm slim`", path);
    for (int i = 0; i < THINGS; i++)
        find_part(folder, &text, keys[i], &bundle.parts[i]);
    if (value_of(&text, "distractors "))
        find_part(folder, &text, "distractors ", &bundle.parts[THINGS]);
    const char *at = value_of(&text, "encoding ");
    bundle.doubled = says(at, "double");
    if (!bundle.doubled && !says(at, "paper"))
        fail("%s: expected encoding double or paper", path);
    at = value_of(&text, "layers ");
    bundle.first = (int)number(&at, "layers", 1, 99);
    bundle.count = (int)number(&at, "layers", 1, MOST_LAYERS);
    at = value_of(&text, "rates ");
    for (int i = 0; i < bundle.count; i++)
        bundle.rates[i] = number(&at, "rates", 0, 1e3);
    at = value_of(&text, "short_gain ");
    bundle.short_gain = number(&at, "short_gain", 1e-3, 1e3);
    for (int i = 0; i < bundle.count; i++) {
        Layer *layer = &bundle.layers[i];
        char key[32];
        snprintf(key, sizeof key, "layer%d ", bundle.first + i);
        at = value_of(&text, key);
        int *sides[] = {&layer->out, &layer->into, &layer->rows, &layer->columns};
        for (int k = 0; k < 4; k++)
            *sides[k] = (int)number(&at, key, 1, k < 2 ? 4096 : 64);
        size_t size = bundle.parts[NETWORK].file.size, out = (size_t)layer->out;
        layer->columns_in_all = (size_t)layer->rows * (size_t)layer->columns * (size_t)layer->into;
        layer->weight_offset = (size_t)number(&at, key, 0, (double)size - 4.0 * (double)out * (double)layer->columns_in_all);
        layer->bias_offset = (size_t)number(&at, key, 0, (double)size - 4.0 * (double)out);
    }
    free(text.bytes);
    return bundle;
}

/* Of object.json top-level keys alone are read: writers give each a line that starts with one
   blank. A text cannot look like that, since JSON has no line breaks in texts. */
Object read_object(const char *folder) {
    char path[PATH_BYTES], digits[65];
    Object object = {0};
    join(path, folder, "object.json");
    File text = read_file(path);
    const char *version = value_of(&text, " \"version\": "), *scale = value_of(&text, " \"scale\": ");
    if (!says(value_of(&text, " \"format\": "), "\"qsgm-object\"") ||
        !(says(version, "1") || says(version, "2")) || value_of(&text, " \"task\": "))
        fail("%s describes no object of a version known here: tune it again", path);
    const char *encoding = value_of(&text, " \"encoding\": "), *offset = value_of(&text, " \"offset_rad\": ");
    object.doubled = says(encoding, "\"double\"");
    object.offset_rad = number(&offset, "offset_rad", -1e3, 1e3);
    if (!object.doubled && !says(encoding, "\"paper\""))
        fail("%s: expected encoding double or paper", path);
    if (scale && number(&scale, "scale", 0, 10) != 1)
        fail("%s was taught at another scale than 1, which this program cannot: use qsgm predict", folder);
    const char *expected = value_of(&text, " \"sha256\": \"");
    join(path, folder, "network.onnx");
    object.network = read_file(path);
    digest(&object.network, digits);
    if (!expected || strncmp(expected, digits, 64))
        fail("%s is altered: its sha256 differs; tune the object again", path);
    free(text.bytes);
    return object;
}

static void remove_unfinished(void) {
    static const char *names[] = {"network.onnx", "object.json", "SHA256SUMS"};
    char path[PATH_BYTES];
    for (int i = 0; i < 3 && *unfinished; i++)
        if (snprintf(path, sizeof path, "%s/%s", unfinished, names[i]) < PATH_BYTES)
            unlink(path);
    if (*unfinished)
        rmdir(unfinished);
}

static void write_file(const char *name, const File *file) {
    char path[PATH_BYTES];
    join(path, unfinished, name);
    FILE *stream = fopen(path, "wb");
    if (!stream || fwrite(file->bytes, 1, file->size, stream) != file->size || fflush(stream) ||
        fsync(fileno(stream)) || fclose(stream))
        fail("cannot write %s: %s", path, strerror(errno));
}

static void begin(const char *folder) {
    int length = snprintf(unfinished, PATH_BYTES, "%s.XXXXXX", folder);
    if (length >= PATH_BYTES)
        errno = ENAMETOOLONG;
    if (length >= PATH_BYTES || !mkdtemp(unfinished)) {
        *unfinished = 0;
        fail("cannot write beside %.200s: %s", folder, strerror(errno));
    }
}

/* Before any work: whether an object can appear there. */
void check_new(const char *folder) {
    struct stat about;
    if (!lstat(folder, &about))
        fail("cannot write %s: it is there already; pass a new name or remove it", folder);
    begin(folder);
    remove_unfinished();
    *unfinished = 0;
}

/* The folder appears whole or not at all. */
void write_object(const char *folder, const char *name, const Object *object) {
    char digits[65], lines[1024], sums[256];
    File description = {0, (uint8_t *)lines}, listing = {0, (uint8_t *)sums};
    begin(folder);
    atexit(remove_unfinished);
    digest(&object->network, digits);
    description.size = (size_t)snprintf(lines, sizeof lines,
        "{\n \"format\": \"qsgm-object\",\n \"version\": 1,\n \"sha256\": \"%s\",\n \"name\": \"%s\",\n"
        " \"encoding\": \"%s\",\n \"offset_rad\": %.17e\n}\n",
        digits, name, object->doubled ? "double" : "paper", object->offset_rad);
    listing.size = (size_t)snprintf(sums, sizeof sums, "%s  network.onnx\n", digits);
    digest(&description, digits);
    listing.size += (size_t)snprintf(sums + listing.size, sizeof sums - listing.size, "%s  object.json\n", digits);
    write_file("network.onnx", &object->network);
    write_file("object.json", &description);
    write_file("SHA256SUMS", &listing);
    if (chmod(unfinished, 0755) || rename(unfinished, folder))
        fail("cannot write %s: %s; pass a new name", folder, strerror(errno));
    *unfinished = 0;
}
