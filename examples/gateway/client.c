/* An actor in C for a Daedalus gateway on this machine: POSIX sockets, no library. It plays CartPole.
 *     cc -O2 -o client client.c -lm && ./client 8080 NAME [EPISODES]       (the run: daedalus learner cartpole) */
#include <arpa/inet.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static int gateway;

static void fail(const char *reason) { fprintf(stderr, "%s\n", reason), exit(1); }
static void get(void *data, size_t size) {
  for (ssize_t n; size; size -= n, data = (char *)data + n)
    if ((n = read(gateway, data, size)) <= 0) fail("the connection to the gateway ended");
}
static void put(int opcode, const char *data, size_t size) { /* one masked frame: RFC 6455, section 5.2 */
  unsigned char frame[1024] = {0x80 | opcode, 0x80 | 126, size >> 8, size, rand(), rand(), rand(), rand()};
  if (size > sizeof frame - 8) fail("the message is too long");
  for (size_t i = 0; i < size; i++) frame[8 + i] = data[i] ^ frame[4 + i % 4];
  if (write(gateway, frame, 8 + size) != (ssize_t)(8 + size)) fail("the connection to the gateway ended");
}
static char *ask(const char *message) { /* send a message; return the answer to it */
  static char answer[4096];
  for (put(1, message, strlen(message));;) {
    unsigned char head[4];
    get(head, 2);
    if (head[1] == 126) get(head + 2, 2);
    size_t size = head[1] == 126 ? head[2] << 8 | head[3] : head[1];
    if (size >= sizeof answer) fail("the answer is too long");
    get(answer, size), answer[size] = 0;
    if (head[0] == 0x89) put(10, answer, size); /* a ping */
    else if (head[0] != 0x81 || strstr(answer, "\"reason\"")) fail(head[0] == 0x81 ? answer : "the gateway closed");
    else return answer;
  }
}
int main(int count, char **words) {
  struct sockaddr_in at = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
  if (count < 3) fail("usage: client PORT NAME [EPISODES]");
  at.sin_port = htons(atoi(words[1])), srand(getpid()), gateway = socket(AF_INET, SOCK_STREAM, 0);
  if (connect(gateway, (void *)&at, sizeof at)) fail("no gateway listens at this port");
  dprintf(gateway, "GET /actor HTTP/1.1\r\nHost: 127.0.0.1:%s\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n", words[1]);
  char text[512], end[4] = "";
  while (memcmp(end, "\r\n\r\n", 4)) memmove(end, end + 1, 3), get(end + 3, 1);
  snprintf(text, sizeof text, "{\"type\":\"hello\",\"version\":1,\"name\":\"%s\",\"observations\":{\"observation\":{\"kind\":"
    "\"array\",\"shape\":[4],\"dtype\":\"float32\"}},\"actions\":{\"action\":{\"kind\":\"discrete\",\"counts\":[2]}}}", words[2]);
  printf("joined %s\n", ask(text)), fflush(stdout);
  for (int episodes = count > 3 ? atoi(words[3]) : 1000000, steps; episodes-- > 0; printf("return %d\n", steps), fflush(stdout)) {
    double x = rand() % 100 / 1e3 - .05, v = 0, a = rand() % 100 / 1e3 - .05, w = 0; /* place, speed, angle, spin */
    for (steps = 0; fabs(x) <= 2.4 && fabs(a) <= .2095 && steps < 500; steps++) {
      snprintf(text, sizeof text, "{\"type\":\"act\",\"observation\":[%g,%g,%g,%g],\"reward\":%d}", x, v, a, w, steps > 0);
      double f = (strstr(ask(text), ":1}") ? 10 : -10) + .05 * w * w * sin(a);
      double turn = (9.8 * sin(a) - cos(a) * f / 1.1) / (.5 * (4 / 3. - .1 * cos(a) * cos(a) / 1.1));
      x += .02 * v, v += .02 * (f - .05 * turn * cos(a)) / 1.1, a += .02 * w, w += .02 * turn;
    }
    put(1, text, snprintf(text, sizeof text, "{\"type\":\"end_episode\",\"terminated\":%s,\"observation\":[%g,%g,%g,%g],"
      "\"reward\":1}", fabs(x) > 2.4 || fabs(a) > .2095 ? "true" : "false", x, v, a, w));
  }
}
