/* The seeds of NumPy's random streams: what numpy.random.SeedSequence(words) gives as
   generate_state(4, uint64), by O'Neill's randutils. */

static uint32_t hashed(uint32_t value, uint32_t *constant, uint32_t factor)
{
    value ^= *constant;
    *constant *= factor;
    value *= *constant;
    return value ^ (value >> 16);
}

static uint32_t mixed(uint32_t a, uint32_t b)
{
    const uint32_t sum = 0xca01f9ddu * a - 0x4973f715u * b;
    return sum ^ (sum >> 16);
}

void stream_seed(const uint32_t *words, int64_t n, uint64_t *seed)
{
    uint32_t pool[4], constant = 0x43b0d7e5u;
    for (int i = 0; i < 4; i++) pool[i] = hashed(i < n ? words[i] : 0, &constant, 0x931e8875u);
    for (int64_t from = 0; from < 4 || from < n; from++) /* every word changes the whole pool */
        for (int i = 0; i < 4; i++)
            if (i != from) {
                const uint32_t value = from < 4 ? pool[from] : words[from];
                pool[i] = mixed(pool[i], hashed(value, &constant, 0x931e8875u));
            }
    constant = 0x8b51f9ddu;
    for (int i = 0; i < 4; i++) {
        const uint64_t low = hashed(pool[2 * i % 4], &constant, 0x58f38dedu);
        seed[i] = low | (uint64_t)hashed(pool[(2 * i + 1) % 4], &constant, 0x58f38dedu) << 32;
    }
}
