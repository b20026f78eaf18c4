/* Runs the program of flasher_dut_process.c inside the suite's own process, as a coroutine: it goes on
 * when the suite has written to it, until it reads again. Link with `--wrap` for the calls below and
 * `-Dmain=bootloader_main`.
 */
#define _GNU_SOURCE

#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/uio.h>
#include <ucontext.h>

int bootloader_main(void);

static ucontext_t suite, bootloader;
static uint8_t stack[256 * 1024];
static uint8_t written[256 * 1024];
static size_t written_size;
static const uint8_t *input;
static size_t input_size;
static int has_begun;

static void run(void)
{
    bootloader_main();
}

/* Goes on with these bytes to read; returns how many bytes it wrote, which are at `found`. */
size_t exchange(const uint8_t *data, size_t size, const uint8_t **found)
{
    input = data;
    input_size = size;
    written_size = 0;
    *found = written;
    if (!has_begun) {
        has_begun = 1;
        getcontext(&bootloader);
        bootloader.uc_stack.ss_sp = stack;
        bootloader.uc_stack.ss_size = sizeof stack;
        makecontext(&bootloader, run, 0);
    }
    swapcontext(&suite, &bootloader);
    return written_size;
}

ssize_t __wrap_read(int file, void *data, size_t size)
{
    (void)file;
    while (input_size == 0)
        swapcontext(&bootloader, &suite);
    size_t part = input_size < size ? input_size : size;
    memcpy(data, input, part);
    input += part;
    input_size -= part;
    return (ssize_t)part;
}

ssize_t __wrap_writev(int file, const struct iovec *parts, int count)
{
    size_t before = written_size;
    (void)file;
    for (int i = 0; i < count; i++) {
        if (written_size + parts[i].iov_len > sizeof written)
            abort();
        if (parts[i].iov_len)
            memcpy(written + written_size, parts[i].iov_base, parts[i].iov_len);
        written_size += parts[i].iov_len;
    }
    return (ssize_t)(written_size - before);
}

/* It has ended: the suite loads it again for its next start. */
void __wrap__exit(int status)
{
    (void)status;
    for (;;)
        swapcontext(&bootloader, &suite);
}

int __wrap_dup(int file)
{
    return file;
}

int __wrap_dup2(int file, int other)
{
    (void)file;
    return other;
}
