/* Golden vectors of the controller @name@, in @precision@ precision.
 *
 * The program repeats a run that quell has computed: noise, missing and absurd samples,
 * saturation, other limits, manual operation and back, restarts. Memory images are compared with
 * quell's, and damaged ones must be refused. It needs no more than a C
 * compiler, and runs on a target whose printf works:
 *
 *     cc -std=c99 -O2 -ffp-contract=off -Isrc test_@name@.c src/@name@.c -lm -o test_@name@
 *     ./test_@name@
 *
 * It ends with 0 if all u are within TOLERANCE of quell's and the status flags are the same, and
 * with 1 if not. Differences are in ulps: the spacing of numbers at |u|, or at the RMS of this u
 * where that is larger. @tolerance_reason@
 */
#include "@name@.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifndef TOLERANCE
#define TOLERANCE @tolerance@ /* [ulp]; the first argument of the program takes its place */
#endif
#define EPSILON @epsilon@
#define REFERENCES @references@
#define MEASUREMENTS @measurements@
#define ACTUATORS @actuators@

typedef @real@ real;

enum action { @actions@ };

typedef struct {
    int action;
    real r[REFERENCES];
    real y[MEASUREMENTS];
    real given[ACTUATORS]; /* u that was applied */
    real u[ACTUATORS]; /* u of the controller */
    int status;
} sample;

static const sample samples[] = {
@rows@
};

static const double scale[ACTUATORS] = {@scale@}; /* RMS of each u */

/* What the controller knows after the last sample. */
typedef struct {
    const char *name;
    real value;
    double size; /* largest |value| of the same kind */
} knowledge;

static const knowledge expected[] = {
@expected@
};

static double in_ulps(real found, real right, double size)
{
    const double ulp = EPSILON * (fabs((double)right) > size ? fabs((double)right) : size);
    return found == right ? 0.0 : fabs((double)found - (double)right) / ulp;
}

@loop@
static void play(@name@_state *state@limited_parameter@, const sample *now, real u[ACTUATORS])
{
@halves@    switch (now->action) {
@cases@
    default:
        break;
    }
    @step@;
}

/* Save, forget everything, load: nothing may change. */
static int power_cycle(@name@_state *state)
{
    static unsigned char image[@NAME@_MEMORY_SIZE];

    @name@_save(state, image);
    @name@_init(state);
    if (@name@_load(state, image, sizeof image, true))
        return 0;
    printf("the memory image is not loaded as it was saved\n");
    return 1;
}

/* ---- Memory images that quell has written ---- */

#define COUNTS @counts@
#define NUMBERS ((int)((@NAME@_MEMORY_SIZE - 40) / sizeof(real)))
/* Each byte of a small image is damaged once, and of a larger one about 4096 of them. */
#define STRIDE (@NAME@_MEMORY_SIZE / 4096 + 1)

/* The words of an image that are not zero, as four bytes from a place on. */
typedef struct {
    unsigned long at;
    unsigned long word;
} image_word;

/* Numbers of an array, and the largest of them. */
typedef struct {
    int count;
    double size;
} image_part;

/* The check of one before the first sample. */
static const unsigned char fresh[8] = {@fresh@};
static const image_word running[] = { /* after @image_sample@ samples */
@running@
};
static const image_word at_rest[] = { /* the same, loaded without resume */
@at_rest@
};
static const image_part parts[] = {
@parts@
};

/* From and until which numbers are the same in all images, and any others are as good. */
static const int constant[][2] = {
    {-1, -1},
@constant@
};

static const unsigned long others[4][2] = { /* 0.5, 2, -2 and 1e9 in single and in double precision */
    {0x3f000000UL, 0x3fe00000UL}, {0x40000000UL, 0x40000000UL},
    {0xc0000000UL, 0xc0000000UL}, {0x4e6e6b28UL, 0x41cdcd65UL},
};

static void put(unsigned char *image, unsigned long at, unsigned long word)
{
    for (int i = 0; i < 4; i++)
        image[at + (unsigned long)i] = (unsigned char)((word >> (8 * i)) & 0xffUL);
}

static void unpack(const image_word *words, size_t count, unsigned char *image)
{
    memset(image, 0, @NAME@_MEMORY_SIZE);
    for (size_t i = 0; i < count; i++)
        put(image, words[i].at, words[i].word);
}

static real number_of(const unsigned char *image, int k)
{
    const unsigned char *first = image + 32 + (size_t)k * sizeof(real);
    real x;
@number@
    return x;
}

/* Write the check of an image whose bytes were changed: FNV-1a with 64 bits over words. */
static void sign(unsigned char *image)
{
    unsigned long long check = 14695981039346656037ULL;

    for (size_t at = 0; at < @NAME@_MEMORY_SIZE - 8; at += 4) {
        const unsigned long long word = (unsigned long long)image[at]
            | (unsigned long long)image[at + 1] << 8 | (unsigned long long)image[at + 2] << 16
            | (unsigned long long)image[at + 3] << 24;

        check = (check ^ word) * 1099511628211ULL & 0xffffffffffffffffULL;
    }
    put(image, @NAME@_MEMORY_SIZE - 8, (unsigned long)(check & 0xffffffffULL));
    put(image, @NAME@_MEMORY_SIZE - 4, (unsigned long)(check >> 32));
}

static int wrong_if(bool condition, const char *what)
{
    if (condition)
        printf("%s\n", what);
    return condition;
}

/* Save over other bytes, so that those that are not written show. */
static void save(const @name@_state *state, unsigned char *image)
{
    memset(image, 0xa5, @NAME@_MEMORY_SIZE);
    @name@_save(state, image);
}

/* An image must be refused, and nothing may have changed. */
static int must_refuse(@name@_state *state, const unsigned char *image, size_t length, const char *what)
{
    static @name@_state before;

    memcpy(&before, state, sizeof before);
    return wrong_if(@name@_load(state, image, length, true), what)
        || wrong_if(memcmp(&before, state, sizeof before) != 0, "a refused image changes the state");
}

/* Make an image with another number k, whose upper 32 bits are given, and the others 0. */
static void with_number(unsigned char *image, const unsigned char *golden, int k, unsigned long bits)
{
    const size_t at = 32 + (size_t)k * sizeof(real);

    memcpy(image, golden, @NAME@_MEMORY_SIZE);
    memset(image + at, 0, sizeof(real));
    put(image, (unsigned long)(at + sizeof(real) - 4), bits);
    sign(image);
}

/* Whether number k is the same in all images: the controller has no use for it. */
static bool is_constant(int k)
{
    for (int i = 0; i < (int)(sizeof constant / sizeof constant[0]); i++)
        if (k >= constant[i][0] && k < constant[i][1])
            return true;
    return false;
}

/* An image with another number k must be refused, as k is a whole number, or saved as it was. */
static int must_keep(@name@_state *state, const unsigned char *image, const unsigned char *golden, int k)
{
    static unsigned char saved[@NAME@_MEMORY_SIZE];

    if (!@name@_load(state, image, @NAME@_MEMORY_SIZE, true))
        return must_refuse(state, image, @NAME@_MEMORY_SIZE, "an image is refused once");
    save(state, saved);
    return wrong_if(memcmp(saved, is_constant(k) ? golden : image, sizeof saved) != 0,
        "a number of an image becomes another one");
}

/* A controller before its first sample is quell's. */
static int begins(const @name@_state *state)
{
    static unsigned char image[@NAME@_MEMORY_SIZE];

    save(state, image);
    return wrong_if(memcmp(image + sizeof image - sizeof fresh, fresh, sizeof fresh) != 0,
        "a controller does not begin as quell's");
}

/* Save as quell, take what quell has saved, and refuse what is damaged; continue from quell's. */
static int images(@name@_state *state, double tolerance)
{
    static unsigned char golden[@NAME@_MEMORY_SIZE], image[@NAME@_MEMORY_SIZE];
    const double most = tolerance > 1.0 / sqrt(EPSILON) ? tolerance : 1.0 / sqrt(EPSILON);
    int wrong = 0, k = 0;

    unpack(running, sizeof running / sizeof running[0], golden);
    save(state, image);
    wrong += wrong_if(memcmp(image, golden, 32) != 0, "the head of the image is not quell's");
    for (int i = 0; i < (int)(sizeof parts / sizeof parts[0]); i++) {
        for (int end = k + parts[i].count; k < end; k++) {
            const double difference =
                in_ulps(number_of(image, k), number_of(golden, k), parts[i].size);

            if (!(difference <= most) && wrong++ == 0)
                printf("number %d of the image is %.@digits@g, must be %.@digits@g\n", k,
                    (double)number_of(image, k), (double)number_of(golden, k));
        }
    }
    @name@_init(state);
    wrong += wrong_if(!@name@_load(state, golden, sizeof golden, false), "quell's image is refused");
    unpack(at_rest, sizeof at_rest / sizeof at_rest[0], golden);
    save(state, image);
    wrong += wrong_if(memcmp(image, golden, sizeof image) != 0, "a loaded image is not at rest");
    unpack(running, sizeof running / sizeof running[0], golden);
    for (size_t at = 0; at < sizeof golden && wrong == 0; at += STRIDE) {
        golden[at] ^= 1;
        wrong += must_refuse(state, golden, sizeof golden, "a damaged image is taken");
        golden[at] ^= 1;
    }
    wrong += must_refuse(state, golden, sizeof golden - 1, "an image that is cut is taken");
    /* The head says what an image is for, but for the count from which positions are counted. */
    for (size_t at = 0; at < 32 && wrong == 0; at += 4) {
        memcpy(image, golden, sizeof image);
        image[at] ^= 1;
        sign(image);
        if (at != 12 || !COUNTS)
            wrong += must_refuse(state, image, sizeof image, "an image with another head is taken");
    }
    wrong += wrong_if(wrong == 0 && !@name@_load(state, image, sizeof image, false),
        "what was learned with other parameters is refused");
    for (k = 0; k < NUMBERS && wrong == 0; k += STRIDE) {
        with_number(image, golden, k, sizeof(real) == 8 ? 0x7ff80000UL : 0x7fc00000UL);
        wrong += must_refuse(state, image, sizeof image, "an image with NaN is taken");
        with_number(image, golden, k, sizeof(real) == 8 ? 0xfff00000UL : 0xff800000UL);
        wrong += must_refuse(state, image, sizeof image, "an image with an infinite number is taken");
        for (int i = 0; i < 4; i++) {
            with_number(image, golden, k, others[i][sizeof(real) == 8]);
            wrong += must_keep(state, image, golden, k);
        }
    }
    wrong += wrong_if(!@name@_load(state, golden, sizeof golden, true), "quell's image is refused");
    save(state, image);
    wrong += wrong_if(memcmp(image, golden, sizeof image) != 0, "a loaded image is saved otherwise");
    return wrong;
}

int main(int argc, char **argv)
{
    const double tolerance = argc > 1 ? atof(argv[1]) : TOLERANCE;
    const int count = (int)(sizeof samples / sizeof samples[0]);
    static @name@_state state;
@limited_variable@    double largest = 0.0;
    int wrong = 0;

    @name@_init(&state);
    wrong += begins(&state);
    for (int k = 0; k < count; k++) {
        const sample *now = &samples[k];
        real u[ACTUATORS] = {@zero@};

        if (k == @image_sample@)
            wrong += images(&state, tolerance);
        if (k == count - 1)
            wrong += power_cycle(&state);
        play(&state@limited_argument@, now, u);
        const int status = @name@_status(&state);

        for (int i = 0; i < ACTUATORS; i++) {
            const double difference = in_ulps(u[i], now->u[i], scale[i]);

            if (difference > largest || !(difference >= 0.0))
                largest = difference;
            if (difference <= tolerance && status == now->status)
                continue;
            if (wrong++ == 0)
                printf("sample %d: u[%d] = %.@digits@g, status %d; must be %.@digits@g, status %d\n", k,
                    i, (double)u[i], status, (double)now->u[i], now->status);
        }
    }
    const @name@_estimate estimate = @name@_get_estimate(&state);
    const real found[] = {
        @found@
    };
    for (int i = 0; i < (int)(sizeof found / sizeof found[0]); i++) {
        const knowledge *right = &expected[i];
        const double difference = in_ulps(found[i], right->value, right->size);

        if (difference > largest || !(difference >= 0.0))
            largest = difference;
        if (difference <= tolerance)
            continue;
        if (wrong++ == 0)
            printf("%s is %.@digits@g, must be %.@digits@g\n", right->name, (double)found[i],
                (double)right->value);
    }
    printf("@name@: %d samples, largest difference %.3g ulp, tolerance %.3g ulp: %s\n",
        @samples@, largest, tolerance, wrong == 0 ? "passed" : "FAILED");
    return wrong == 0 ? 0 : 1;
}
