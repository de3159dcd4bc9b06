/* A servo that keeps what it has learned when its power goes, for 12_memory.py.
 *
 * Each run of the program is a day: it loads the memory image from the flash memory, turns the axis
 * for some revolutions, saves, and ends, as by a power-off. The flash memory is the file flash.bin of
 * the computer that the debugger or the emulator runs on (semihosting). The encoder has no index
 * pulse: it counts from where the axis stands at the start, which is START.
 *
 * It prints the RMS error of each half revolution, and ends with 0 if the image was as expected.
 */
#include <math.h>
#include <stdio.h>
#include "plant.h"
#include "servo.h"

enum { SAMPLES = HALVES * HALF };

static servo_state servo;
static plant_state plant;
static unsigned char image[SERVO_MEMORY_SIZE];

static bool load(void)
{
    FILE *flash = fopen("flash.bin", "rb");
    size_t length;

    if (!flash)
        return false; /* the first day: nothing is learned */
    length = fread(image, 1, sizeof image, flash);
    fclose(flash);
    image[100] ^= 1; /* a bit that has turned over must be noticed */
    if (servo_load(&servo, image, length, false))
        return false;
    image[100] ^= 1;
    return servo_load(&servo, image, length, false);
}

static bool save(void)
{
    FILE *flash = fopen("flash.bin", "wb");
    size_t written;

    servo_save(&servo, image);
    if (!flash)
        return false;
    written = fwrite(image, 1, sizeof image, flash);
    return fclose(flash) == 0 && written == sizeof image;
}

int main(void)
{
    const float slope = SPEED;
    double zero, sum = 0.0;

    servo_init(&servo);
    plant_init(&plant);
    plant.x[0] = START;
    zero = plant_measure(&plant);
    printf("%s\n", load() ? "loaded" : "nothing learned");
    for (int k = 0; k < SAMPLES; k++) {
        const float r = slope * (float)k * (float)SERVO_SAMPLE_TIME;
        const float y = (float)(plant_measure(&plant) - zero);
        const double load_torque[PLANT_DISTURBANCES] = {0.0};

        plant_advance(&plant, k * PLANT_SAMPLE_TIME, servo_step(&servo, r, y, slope, 0.0f),
            load_torque);
        sum += (double)(r - y) * (double)(r - y);
        if ((k + 1) % HALF == 0) {
            printf("%.6g\n", sqrt(sum / HALF));
            sum = 0.0;
        }
    }
    return save() ? 0 : 1;
}
