/* The sheet of drawn things that a bundle brings: a PNG of 128x128 tiles, rows without filter. */
#include "qsgm.h"

#include <stdlib.h>
#include <string.h>

typedef struct { /* deflated data, and the bytes that it becomes */
    const uint8_t *in;
    size_t bit, bits, made, room;
    uint8_t *out;
    int broken;
} Inflation;

typedef struct { /* how many codes of each length there are, and what they stand for */
    int count[16], symbol[320];
} Code;

static int bits(Inflation *z, int count) {
    int value = 0;
    for (int i = 0; i < count; i++, z->bit++) {
        if (z->bit >= z->bits)
            return z->broken = 1, 0;
        value |= (z->in[z->bit / 8] >> z->bit % 8 & 1) << i;
    }
    return value;
}

static Code make_code(const uint8_t *lengths, int symbols) {
    Code code = {{0}, {0}};
    for (int length = 1, made = 0; length < 16; length++)
        for (int i = 0; i < symbols; i++)
            if (lengths[i] == length)
                code.symbol[made++] = i, code.count[length]++;
    return code;
}

static int symbol(Inflation *z, const Code *code) {
    for (int length = 1, value = 0, first = 0; length < 16; length++) {
        value += bits(z, 1);
        if (value < code->count[length])
            return code->symbol[first + value];
        first += code->count[length];
        value = (value - code->count[length]) << 1;
    }
    return z->broken = 1, 0;
}

static void read_lengths(Inflation *z, uint8_t *lengths, int count, int few) {
    const int order[] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
    uint8_t short_ones[19] = {0};
    for (int i = 0; i < few; i++)
        short_ones[order[i]] = (uint8_t)bits(z, 3);
    Code code = make_code(short_ones, 19);
    for (int i = 0; i < count && !z->broken;) {
        int what = symbol(z, &code), length = what < 16 ? what : 0, times = 1;
        if (what == 16)
            length = i > 0 ? lengths[i - 1] : 0, times = 3 + bits(z, 2);
        else if (what > 16)
            times = what == 17 ? 3 + bits(z, 3) : 11 + bits(z, 7);
        for (; times > 0 && i < count; times--)
            lengths[i++] = (uint8_t)length;
    }
}

static void inflate_block(Inflation *z, int kind) {
    uint8_t lengths[320] = {0};
    int many = 288, far = 30;
    if (kind == 2) {
        many = 257 + bits(z, 5), far = 1 + bits(z, 5);
        read_lengths(z, lengths, many + far, 4 + bits(z, 4));
    } else
        for (int i = 0; i < 318; i++)
            lengths[i] = i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : i < 288 ? 8 : 5;
    Code literals = make_code(lengths, many), distances = make_code(lengths + many, far);
    for (int what; (what = symbol(z, &literals)) != 256 && !z->broken;) {
        int length = 1, back = 0;
        if (what > 256) {
            int more = what < 265 || what == 285 ? 0 : (what - 261) / 4;
            length = what < 265 ? what - 254 : what == 285 ? 258 : 3 + ((4 + (what - 1) % 4) << more);
            length += bits(z, more);
            int code = symbol(z, &distances), extra = code < 4 ? 0 : code / 2 - 1;
            back = code < 4 ? code + 1 : 1 + ((2 + code % 2) << extra) + bits(z, extra);
        }
        if (what > 285 || (size_t)back > z->made || (size_t)length > z->room - z->made)
            z->broken = 1;
        for (; length > 0 && !z->broken; length--, z->made++)
            z->out[z->made] = back ? z->out[z->made - (size_t)back] : (uint8_t)what;
    }
}

static void copy_block(Inflation *z) {
    z->bit = (z->bit + 7) / 8 * 8;
    int length = bits(z, 16), check = bits(z, 16);
    if (check != (length ^ 0xffff) || (size_t)length > z->room - z->made)
        z->broken = 1;
    for (; length > 0 && !z->broken; length--)
        z->out[z->made++] = (uint8_t)bits(z, 8);
}

static int inflate(Inflation *z) {
    bits(z, 16); /* zlib's header */
    for (int last = 0; !last && !z->broken;) {
        last = bits(z, 1);
        int kind = bits(z, 2);
        if (kind == 0)
            copy_block(z);
        else if (kind < 3)
            inflate_block(z, kind);
        else
            z->broken = 1;
    }
    return !z->broken && z->made == z->room;
}

/* The rows of the picture, each behind its filter; all IDAT chunks are one stream. */
static uint8_t *unpacked(const File *file, size_t width, size_t height) {
    Inflation z = {.in = memory(file->size), .room = height * (1 + 4 * width)};
    uint8_t *packed = (uint8_t *)z.in;
    z.out = memory(z.room);
    for (size_t at = 8, length; at + 12 <= file->size; at += 12 + length) {
        length = big_endian(file->bytes + at);
        if (length > file->size - at - 12)
            break;
        if (!memcmp(file->bytes + at + 4, "IDAT", 4))
            memcpy(packed + z.bits / 8, file->bytes + at + 8, length), z.bits += length * 8;
    }
    if (!inflate(&z))
        fail("the sheet of things is damaged: get the bundle anew");
    free(packed);
    return z.out;
}

/* Colours as BGR; how far the outermost visible pixels are from the middle, rounded up. */
static void take_tile(Thing *thing, const uint8_t *corner, size_t stride) {
    memset(thing, 0, sizeof *thing);
    for (int pass = 0; pass < 2; pass++) /* what lies further out than the visible is left out */
        for (int y = 0; y < SIDE; y++)
            for (int x = 0; x < SIDE; x++) {
                const uint8_t *rgba = corner + (size_t)y * stride + 4 * x;
                int away[2] = {(abs(2 * x - SIDE + 1) + 1) / 2, (abs(2 * y - SIDE + 1) + 1) / 2};
                for (int k = 0; k < 2 && !pass && rgba[3]; k++)
                    thing->reach[k] = away[k] > thing->reach[k] ? away[k] : thing->reach[k];
                int inside = away[0] <= thing->reach[0] && away[1] <= thing->reach[1];
                for (int k = 0; k < 4 && pass && inside; k++)
                    thing->pixels[(y * SIDE + x) * 4 + k] = rgba[k < 3 ? 2 - k : 3];
            }
}

int read_things(const File *file, Thing **things) {
    static const uint8_t start[] = "\x89PNG\r\n\x1a\n\0\0\0\rIHDR", kind[] = {8, 6, 0, 0, 0};
    size_t width = 0, height = 0, count;
    if (file->size > 33 && !memcmp(file->bytes, start, 16) && !memcmp(file->bytes + 24, kind, 5))
        width = big_endian(file->bytes + 16), height = big_endian(file->bytes + 20);
    if (!width || !height || width % SIDE || height % SIDE || width > 2048 || height > 2048)
        fail("the sheet of things is no PNG of 8-bit RGBA tiles of 128x128: get the bundle anew");
    uint8_t *rows = unpacked(file, width, height);
    size_t stride = 1 + 4 * width, across = width / SIDE;
    for (size_t y = 0; y < height; y++)
        if (rows[y * stride])
            fail("the sheet of things has filtered rows: get the bundle anew");
    count = across * (height / SIDE);
    *things = memory(count * sizeof **things);
    for (size_t i = 0; i < count; i++)
        take_tile(*things + i, rows + i / across * SIDE * stride + 1 + i % across * 4 * SIDE, stride);
    free(rows);
    return (int)count;
}
