// Sends one or more frames to a SCas4D service in one binary body (S4DF, docs/api.md), with C++17 and POSIX sockets.
// It uses plain HTTP; on an untrusted network, add a TLS proxy or an SSH tunnel.
//
//     c++ -std=c++17 -O2 send_frame.cpp -o send_frame
//     SCAS4D_TOKEN=... ./send_frame http://127.0.0.1:8000 SCENE 0 north=0.jpg east=1.jpg mask.north=0.png time=0.25
//
// An index begins the next frame: ... SCENE 7 north=n7.jpg east=e7.jpg 8 north=n8.jpg east=e8.jpg
//
// It prints the response, with an answer for each frame. Exit status: 0 all acknowledged (202), 1 at least one frame
// refused (207) or service unreachable, 2 invalid arguments.
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include <algorithm>
#include <cctype>
#include <cerrno>
#include <csignal>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iostream>
#include <iterator>
#include <stdexcept>
#include <string>
using std::string;
constexpr int kTries = 60;         // maximum number of attempts if the service answers 429 or 503
constexpr long kLongestWait = 60;  // maximum seconds between attempts
constexpr long kSilence = 60;      // seconds without traffic after which the connection is closed

struct Answer {
    int status = 0;
    bool later = false;     // whether to send the same frames again, after
    long retry_after = 1;  // seconds
    string body;
};

string read_file(const string& path) {
    std::ifstream file(path, std::ios::binary);
    string data{std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
    if (!file || data.empty()) throw std::runtime_error(path + " cannot be read, or is empty");
    return data;
}

// Camera names need no escaping in JSON, because the service only accepts these characters.
string camera_name(const string& name) {
    const auto plain = [](unsigned char c) { return std::isalnum(c) || c == '.' || c == '_' || c == '-'; };
    if (name.empty() || !std::all_of(name.begin(), name.end(), plain))
        throw std::runtime_error("'" + name + "' cannot be the name of a camera");
    return name;
}

bool is_index(const string& argument) {
    return !argument.empty() && argument.find_first_not_of("0123456789") == string::npos;
}

// One frame: S4DF, the header length as little-endian uint32, the header as JSON, and the files.
string frame_bytes(const string& index, int count, char** arguments) {
    string listed, files, time;
    for (int i = 0; i < count; ++i) {
        const string argument = arguments[i], key = argument.substr(0, argument.find('='));
        if (key.size() == argument.size()) throw std::runtime_error("'" + argument + "' is not CAMERA=PICTURE");
        const string value = argument.substr(key.size() + 1);
        if (key == "time") {
            time = ",\"time\":" + value;
            continue;
        }
        const bool mask = key.rfind("mask.", 0) == 0;
        const string data = read_file(value);
        listed += string(listed.empty() ? "" : ",") + "{\"camera\":\"" + camera_name(mask ? key.substr(5) : key) +
                  "\",\"kind\":\"" + (mask ? "mask" : "image") + "\",\"size\":" + std::to_string(data.size()) + "}";
        files += data;
    }
    const string head = "{\"index\":" + index + time + ",\"files\":[" + listed + "]}";
    string body = "S4DF";
    for (int shift = 0; shift < 32; shift += 8) body += static_cast<char>(head.size() >> shift & 0xff);
    return body + head + files;
}

int connected(const string& host, const string& port) {
    addrinfo hints{}, *found = nullptr;
    hints.ai_socktype = SOCK_STREAM;
    if (const int error = getaddrinfo(host.c_str(), port.c_str(), &hints, &found))
        throw std::runtime_error(host + ": " + gai_strerror(error));
    int fd = -1;
    for (addrinfo* at = found; at != nullptr && fd < 0; at = at->ai_next) {
        fd = socket(at->ai_family, at->ai_socktype, at->ai_protocol);
        if (fd >= 0 && connect(fd, at->ai_addr, at->ai_addrlen) != 0) close(fd), fd = -1;
    }
    freeaddrinfo(found);
    if (fd < 0) throw std::runtime_error(host + ":" + port + " cannot be reached: " + std::strerror(errno));
    const timeval silence{kSilence, 0};
    const int on = 1;
    setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &silence, sizeof silence);
    setsockopt(fd, SOL_SOCKET, SO_SNDTIMEO, &silence, sizeof silence);
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    return fd;
}

// A failed send is not an error: if the service closes the connection early, its response gives the reason.
void send_all(int fd, const string& data) {
    ssize_t n = 0;
    for (size_t sent = 0; sent < data.size(); sent += static_cast<size_t>(n))
        if ((n = send(fd, data.data() + sent, data.size() - sent, 0)) <= 0) return;
}

// The frames one after another. Each begins with its index.
string batch_body(int count, char** arguments) {
    string body;
    for (int begin = 0, end; begin < count; begin = end) {
        for (end = begin + 1; end < count && !is_index(arguments[end]); ++end) {
        }
        body += frame_bytes(arguments[begin], end - begin - 1, arguments + begin + 1);
    }
    return body;
}

Answer exchange(const string& host, const string& port, const string& header, const string& body) {
    const int fd = connected(host, port);
    send_all(fd, header);
    send_all(fd, body);
    string received;
    char buffer[65536];
    for (ssize_t n; (n = recv(fd, buffer, sizeof buffer, 0)) > 0;) received.append(buffer, static_cast<size_t>(n));
    close(fd);
    const size_t end = received.find("\r\n\r\n");
    if (received.rfind("HTTP/1.1 ", 0) != 0 || end == string::npos)
        throw std::runtime_error("the connection broke before an answer came; it is safe to send the frames again");
    const int status = std::atoi(received.c_str() + 9);
    Answer answer{status, status == 429 || status == 503, 1, received.substr(end + 4)};
    received.resize(end);
    for (char& c : received) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
    const size_t field = received.find("\r\nretry-after:");
    if (field != string::npos) answer.retry_after = std::atol(received.c_str() + field + 14);
    const string member = "\"retry_after\":";  // of a frame in a batch; null if it must not be sent again
    for (size_t at = 0; status == 207 && (at = answer.body.find(member, at)) != string::npos;) {
        at += member.size();
        if (std::isdigit(static_cast<unsigned char>(answer.body[at]))) {
            answer.later = true;
            answer.retry_after = std::atol(answer.body.c_str() + at);
        }
    }
    return answer;
}

int main(int argc, char** argv) try {
    const string url = argc > 1 ? argv[1] : "", scheme = "http://";
    const size_t colon = url.rfind(':');
    if (argc < 5 || url.rfind(scheme, 0) != 0 || colon < scheme.size() || !is_index(argv[3])) {
        std::cerr << "usage: send_frame http://HOST:PORT SCENE INDEX CAMERA=FILE... mask.CAMERA=FILE... time=SECONDS"
                     " [INDEX ...]\n";
        return 2;
    }
    std::signal(SIGPIPE, SIG_IGN);
    const string host = url.substr(scheme.size(), colon - scheme.size()), port = url.substr(colon + 1);
    const string body = batch_body(argc - 3, argv + 3);
    const bool single = std::count_if(argv + 3, argv + argc, is_index) == 1;
    const string request = single ? "PUT /v1/scenes/" + string(argv[2]) + "/frames/" + argv[3]
                                  : "POST /v1/scenes/" + string(argv[2]) + "/frames";
    string header = request + " HTTP/1.1\r\nHost: " + host + ":" + port + "\r\nConnection: close\r\nContent-Type: application/vnd.scas4d.frame\r\n";
    const char* token = std::getenv("SCAS4D_TOKEN");
    if (token != nullptr && *token != '\0') header += "Authorization: Bearer " + string(token) + "\r\n";
    header += "Content-Length: " + std::to_string(body.size()) + "\r\n\r\n";
    for (int tries = 1;; ++tries) {
        const Answer answer = exchange(host, port, header, body);
        (answer.status == 202 ? std::cout : std::cerr) << answer.status << " " << answer.body << std::endl;
        if (!answer.later || tries == kTries) return answer.status == 202 ? 0 : 1;
        const long wait = std::min(std::max(answer.retry_after, 1L), kLongestWait);
        std::cerr << "sending again in " << wait << " s" << std::endl;
        sleep(static_cast<unsigned>(wait));
    }
} catch (const std::exception& error) {
    std::cerr << "send_frame: " << error.what() << std::endl;
    return 1;
}
