#include "board.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))

#define SYSTICK_CONTROL REGISTER(0xE000E010u)
#define SYSTICK_RELOAD REGISTER(0xE000E014u)
#define SYSTICK_VALUE REGISTER(0xE000E018u)
#define INTERRUPT_ENABLE REGISTER(0xE000E100u)
#define INTERRUPT_DISABLE REGISTER(0xE000E180u)
#define VECTOR_TABLE REGISTER(0xE000ED08u)
#define RESET_CONTROL REGISTER(0xE000ED0Cu)

#define UART_DATA REGISTER(0x40004000u)
#define UART_STATE REGISTER(0x40004004u)
#define UART_CONTROL REGISTER(0x40004008u)
#define UART_INTERRUPT REGISTER(0x4000400Cu)
#define UART_DIVIDER REGISTER(0x40004010u)

enum {
    CLOCK_HZ = 25000000,
    SEND_FULL = 1,       /* state */
    SEND_ENABLE = 1,     /* control */
    RECEIVE_ENABLE = 2,
    RECEIVE_INTERRUPT_ENABLE = 8,
    RECEIVE_INTERRUPT = 2,
    UART_NUMBER = 0, /* its interrupt */
    RING_BYTES = 512,
    LINE_BYTES = 27, /* T, id, length, 8 bytes of data */
};

static volatile uint32_t ms;

static volatile uint8_t ring[RING_BYTES];
static volatile uint32_t ring_in;
static uint32_t ring_out;

static char line[LINE_BYTES];
static uint32_t line_length;

void systick_handler(void)
{
    ++ms;
}

void uart_handler(void)
{
    if (ring_in - ring_out == RING_BYTES) {
        INTERRUPT_DISABLE = 1u << UART_NUMBER; /* until there is room for more characters */
        return;
    }
    UART_INTERRUPT = RECEIVE_INTERRUPT;
    ring[ring_in % RING_BYTES] = (uint8_t)UART_DATA;
    ++ring_in;
}

void board_start(void)
{
    SYSTICK_RELOAD = CLOCK_HZ / 1000 - 1;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = 7; /* enabled, with interrupt, processor clock */
    UART_DIVIDER = 16;
    UART_CONTROL = SEND_ENABLE | RECEIVE_ENABLE | RECEIVE_INTERRUPT_ENABLE;
    INTERRUPT_ENABLE = 1u << UART_NUMBER;
}

uint32_t board_ms(void)
{
    return ms;
}

/* -- slcan: a line for each frame, "t7528" and 16 hexadecimal digits --------------------------- */

static void put(char character)
{
    while (UART_STATE & SEND_FULL) {
    }
    UART_DATA = (uint8_t)character;
}

static void put_hex(uint32_t value, unsigned digits)
{
    while (digits-- > 0)
        put("0123456789ABCDEF"[value >> (4 * digits) & 15]);
}

void board_send(const can_frame *frame)
{
    put('t');
    put_hex(frame->id, 3);
    put_hex(frame->length, 1);
    for (uint8_t i = 0; i < frame->length; ++i)
        put_hex(frame->data[i], 2);
    put('\r');
}

bool board_sent_all(void)
{
    return !(UART_STATE & SEND_FULL);
}

/* Returns false when the line is too short or has no digits. */
static bool get_hex(uint32_t *at, unsigned digits, uint32_t *value)
{
    *value = 0;
    for (; digits > 0; --digits, ++*at) {
        const char digit = *at < line_length ? line[*at] : ' ';
        if (digit >= '0' && digit <= '9')
            *value = *value << 4 | (uint32_t)(digit - '0');
        else if (digit >= 'A' && digit <= 'F')
            *value = *value << 4 | (uint32_t)(digit - 'A' + 10);
        else if (digit >= 'a' && digit <= 'f')
            *value = *value << 4 | (uint32_t)(digit - 'a' + 10);
        else
            return false;
    }
    return true;
}

static bool get_frame(can_frame *frame)
{
    uint32_t at = 1, length, value;
    const char kind = line_length > 0 ? line[0] : ' ';
    frame->extended = kind == 'T' || kind == 'R';
    frame->remote = kind == 'r' || kind == 'R';
    if (kind != 't' && !frame->extended && !frame->remote)
        return false;
    if (!get_hex(&at, frame->extended ? 8 : 3, &frame->id) || !get_hex(&at, 1, &length) ||
        length > 8)
        return false;
    frame->length = (uint8_t)length;
    for (uint32_t i = 0; i < length && !frame->remote; ++i) {
        if (!get_hex(&at, 2, &value))
            return false;
        frame->data[i] = (uint8_t)value;
    }
    return at == line_length;
}

bool board_receive(can_frame *frame)
{
    while (ring_out != ring_in) {
        const char character = (char)ring[ring_out % RING_BYTES];
        ++ring_out;
        INTERRUPT_ENABLE = 1u << UART_NUMBER;
        if (character != '\r') {
            if (line_length < LINE_BYTES)
                line[line_length++] = character; /* a longer line is not a frame */
            continue;
        }
        const bool is_frame = get_frame(frame);
        line_length = 0;
        if (is_frame)
            put('z'); /* frame sent; other commands (open, close, bit rate) need no action */
        put('\r');
        if (is_frame)
            return true;
    }
    return false;
}

/* Masked interrupts end the sleep too, so that none is missed before it. */
void board_sleep(void)
{
    __asm volatile("cpsid i");
    if (ring_out == ring_in)
        __asm volatile("wfi");
    __asm volatile("cpsie i");
}

/* -- reset and start of a program -------------------------------------------------------------- */

_Noreturn void board_reset(void)
{
    RESET_CONTROL = 0x05FA0004u;
    for (;;) {
    }
}

_Noreturn void board_enter(uint32_t vectors)
{
    INTERRUPT_DISABLE = 1u << UART_NUMBER;
    SYSTICK_CONTROL = 0;
    UART_CONTROL = 0;
    VECTOR_TABLE = vectors;
    __asm volatile("msr msp, %0\n\tdsb\n\tisb\n\tbx %1"
                   :
                   : "r"(REGISTER(vectors)), "r"(REGISTER(vectors + 4)));
    __builtin_unreachable();
}
