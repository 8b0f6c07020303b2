/* Frames of the jaxsonar protocol, version 1.0 (docs/protocol.md), for firmware. C99 or C++, no allocation.
 *
 * Frames are written directly to the caller's buffer; COBS and CRC-32 are computed on the fly. Both encoders return the
 * number of bytes to send, including the final 0x00, or 0 if the buffer is too small or there are more than 4096 echoes.
 * float and double must be IEEE 754. Any byte order of the machine works.
 */
#ifndef JAXSONAR_WIRE_H
#define JAXSONAR_WIRE_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define JAXSONAR_PAYLOAD(echoes) (36u + 14u * (size_t)(echoes))
/* Maximum size of a frame with this number of echoes, bytes. For a pose: JAXSONAR_FRAME(1). */
#define JAXSONAR_FRAME(echoes) (JAXSONAR_PAYLOAD(echoes) + JAXSONAR_PAYLOAD(echoes) / 254u + 2u)

typedef struct {
    uint16_t tx, rx;  /* transmitter, receiver */
    uint8_t echo;     /* number of the echo of this path from 0, nearest first */
    uint8_t flags;    /* 1 ring-down, 2 saturated */
    float time_us;    /* two-way time of flight, above 0 and up to 1e6 */
    float amplitude;  /* NAN if not measured */
} jaxsonar_echo;

typedef struct {
    uint32_t sequence;      /* sequence number over all frames of this device */
    uint64_t time_us;       /* device clock when the group fired */
    uint32_t scan;
    uint16_t group, groups; /* group 0 to groups - 1 of the scan */
    float temperature;      /* deg C, NAN if not measured */
} jaxsonar_group;

typedef struct {
    uint32_t sequence;
    uint64_t time_us;
    double x, y, theta;  /* odometry: metres, radians counter-clockwise; three NAN if unknown */
} jaxsonar_pose;

typedef struct {
    uint8_t *out;
    size_t size, used, code; /* code: position of the length byte of the current COBS block */
    uint32_t crc;
} jaxsonar_writer;

static inline uint32_t jaxsonar_crc32(uint32_t crc, uint8_t byte) /* start with 0; the reflected 0xEDB88320 */
{
    crc = ~crc ^ byte;
    for (int bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ (0xEDB88320u & (0u - (crc & 1u)));
    return ~crc;
}

static inline void jaxsonar_stuff(jaxsonar_writer *w, uint8_t byte) /* append a byte, COBS-encoded */
{
    if (w->used - w->code == 255) { /* the block is full: it ends without a zero */
        if (w->code < w->size) w->out[w->code] = 255;
        w->code = w->used++;
    }
    if (byte == 0) {
        if (w->code < w->size) w->out[w->code] = (uint8_t)(w->used - w->code);
        w->code = w->used++;
    } else {
        if (w->used < w->size) w->out[w->used] = byte;
        w->used++;
    }
}

static inline void jaxsonar_put(jaxsonar_writer *w, uint64_t value, int bytes) /* little-endian */
{
    for (; bytes > 0; bytes--, value >>= 8) {
        w->crc = jaxsonar_crc32(w->crc, (uint8_t)value);
        jaxsonar_stuff(w, (uint8_t)value);
    }
}

static inline void jaxsonar_put_float(jaxsonar_writer *w, float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    jaxsonar_put(w, bits, 4);
}

static inline void jaxsonar_put_double(jaxsonar_writer *w, double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    jaxsonar_put(w, bits, 8);
}

static inline void jaxsonar_begin(jaxsonar_writer *w, uint8_t *out, size_t size, int type, uint32_t seq, uint64_t time)
{
    w->out = out;
    w->size = size;
    w->used = 1;
    w->code = 0;
    w->crc = 0;
    jaxsonar_put(w, 1, 1); /* version 1.0 */
    jaxsonar_put(w, 0, 1);
    jaxsonar_put(w, (uint64_t)type, 1);
    jaxsonar_put(w, 0, 1);
    jaxsonar_put(w, seq, 4);
    jaxsonar_put(w, time, 8);
}

static inline size_t jaxsonar_finish(jaxsonar_writer *w)
{
    jaxsonar_put(w, w->crc, 4);
    if (w->used >= w->size) return 0;
    w->out[w->code] = (uint8_t)(w->used - w->code);
    w->out[w->used++] = 0;
    return w->used;
}

static inline size_t jaxsonar_encode_group(uint8_t *out, size_t size, const jaxsonar_group *group,
                                           const jaxsonar_echo *echoes, size_t count)
{
    jaxsonar_writer w;
    if (count > 4096) return 0;
    jaxsonar_begin(&w, out, size, 1, group->sequence, group->time_us);
    jaxsonar_put(&w, group->scan, 4);
    jaxsonar_put(&w, group->group, 2);
    jaxsonar_put(&w, group->groups, 2);
    jaxsonar_put_float(&w, group->temperature);
    jaxsonar_put(&w, count, 4); /* 16-bit count and 16 reserved bits */
    for (const jaxsonar_echo *e = echoes; count > 0; e++, count--) {
        jaxsonar_put(&w, e->tx, 2);
        jaxsonar_put(&w, e->rx, 2);
        jaxsonar_put(&w, e->echo, 1);
        jaxsonar_put(&w, e->flags, 1);
        jaxsonar_put_float(&w, e->time_us);
        jaxsonar_put_float(&w, e->amplitude);
    }
    return jaxsonar_finish(&w);
}

static inline size_t jaxsonar_encode_pose(uint8_t *out, size_t size, const jaxsonar_pose *pose)
{
    jaxsonar_writer w;
    jaxsonar_begin(&w, out, size, 2, pose->sequence, pose->time_us);
    jaxsonar_put_double(&w, pose->x);
    jaxsonar_put_double(&w, pose->y);
    jaxsonar_put_double(&w, pose->theta);
    return jaxsonar_finish(&w);
}

/* Decode COBS in place and check the CRC. frame is without its final 0x00. Returns the length of the record, or 0. */
static inline size_t jaxsonar_decode(uint8_t *frame, size_t length)
{
    size_t in = 0, out = 0, block = 0;
    uint32_t crc = 0, sent = 0;
    while (in < length) {
        const uint8_t code = frame[in++];
        if (code == 0 || code - 1u > length - in) return 0;
        for (block = code; block > 1; block--) {
            if (frame[in] == 0) return 0;
            frame[out++] = frame[in++];
        }
        if (code < 255 && in < length) frame[out++] = 0;
    }
    if (out < 20) return 0;
    for (in = 0; in < out - 4; in++) crc = jaxsonar_crc32(crc, frame[in]);
    for (in = 0; in < 4; in++) sent |= (uint32_t)frame[out - 4 + in] << (8 * in);
    return crc == sent ? out - 4 : 0;
}

#endif
