// Streams a small scene to a probeless server and uses its light: go run stream.go http://localhost:8080/?token=TOKEN
//
// Written from protocol/README.md and protocol/fields.md alone, with Go's standard library and nothing else: a WebSocket,
// MessagePack, and the conversation. Replace scene() by your camera.
package main

import (
	"bufio"
	"bytes"
	"compress/flate"
	"crypto/rand"
	"crypto/tls"
	"encoding/base64"
	"encoding/binary"
	"errors"
	"fmt"
	"image"
	"image/color"
	"image/jpeg"
	"io"
	"math"
	"net"
	"net/http"
	"net/url"
	"os"
	"strconv"
	"time"
)

const (
	width, height, focal = 64, 48, 60.0 // pixels
	depthScale           = 0.001        // metres for each unit of depth
	patience             = 120 * time.Second
	maxMessage           = 300 << 20 // bytes; a mesh of the scene comes in parts that are smaller
)

// ---- the scene: a floor and a wall of a box, seen from a camera that moves to the right ----

// scene gives frame n: sRGB picture, depth (0 is no measurement) and world_from_camera, row-major.
func scene(n int) (*image.RGBA, []uint16, []any) {
	shift := 0.02 * float64(n)
	picture, depth := image.NewRGBA(image.Rect(0, 0, width, height)), make([]uint16, width*height)
	for v := 0; v < height; v++ {
		for u := 0; u < width; u++ {
			x, y := (float64(u)-(width-1)/2.0)/focal, (float64(v)-(height-1)/2.0)/focal
			z, shade := 2.0, uint8(170) // the wall; y points down, so that the floor is at y = 0.6
			if y > 0.3 {
				z, shade = 0.6/y, 220
			}
			if int(math.Floor(4*(x*z+shift)))%2 == 0 {
				shade -= 60
			}
			picture.Set(u, v, color.RGBA{shade, shade, shade, 255})
			depth[v*width+u] = uint16(math.Round(z / depthScale))
		}
	}
	return picture, depth, []any{1.0, 0.0, 0.0, shift, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0}
}

// zdelta is the depth codec of that name: differences along rows, folded, low bytes then high bytes, raw deflate.
func zdelta(depth []uint16) ([]byte, error) {
	planes := make([]byte, 2*len(depth))
	for i, value := range depth {
		left := uint16(0)
		if i%width > 0 {
			left = depth[i-1]
		}
		d := int16(value - left)
		z := uint16(d<<1) ^ uint16(d>>15)
		planes[i], planes[len(depth)+i] = byte(z), byte(z>>8)
	}
	var packed bytes.Buffer
	deflate, err := flate.NewWriter(&packed, flate.BestSpeed)
	if err != nil {
		return nil, err
	}
	_, err = deflate.Write(planes)
	err = errors.Join(err, deflate.Close()) // which writes the stream's end
	return packed.Bytes(), err
}

// ---- MessagePack: maps with string keys, arrays, bin, str, numbers, nil and booleans ----

type message = map[string]any

func pack(out []byte, value any) []byte {
	sized := func(code byte, n int) []byte { // str 32, bin 32, array 32, map 32
		return binary.BigEndian.AppendUint32(append(out, code), uint32(n))
	}
	switch v := value.(type) {
	case nil:
		return append(out, 0xc0)
	case bool:
		return append(out, map[bool]byte{false: 0xc2, true: 0xc3}[v])
	case int:
		return binary.BigEndian.AppendUint64(append(out, 0xd3), uint64(v))
	case float64:
		return binary.BigEndian.AppendUint64(append(out, 0xcb), math.Float64bits(v))
	case string:
		return append(sized(0xdb, len(v)), v...)
	case []byte:
		return append(sized(0xc6, len(v)), v...)
	case []any:
		out = sized(0xdd, len(v))
		for _, item := range v {
			out = pack(out, item)
		}
		return out
	case message:
		out = sized(0xdf, len(v))
		for name, field := range v { // in any order
			out = pack(pack(out, name), field)
		}
		return out
	}
	panic(fmt.Sprintf("cannot pack %T", value))
}

// unpack reads one value: message, []any, []byte, string, int, float64, bool or nil.
func unpack(in *bytes.Reader) any {
	code := must(in.ReadByte())
	number := func(n int) uint64 {
		var wide [8]byte
		must(io.ReadFull(in, wide[8-n:]))
		return binary.BigEndian.Uint64(wide[:])
	}
	signed := func(n int) int { return int(int64(number(n)<<(64-8*n)) >> (64 - 8*n)) }
	raw := func(n uint64) []byte {
		if n > uint64(in.Len()) {
			panic(io.ErrUnexpectedEOF)
		}
		data := make([]byte, n)
		must(io.ReadFull(in, data))
		return data
	}
	list := func(n uint64) []any {
		items := []any{}
		for ; n > 0; n-- {
			items = append(items, unpack(in))
		}
		return items
	}
	fields := func(n uint64) message {
		found := message{}
		for ; n > 0; n-- {
			name, _ := unpack(in).(string)
			found[name] = unpack(in)
		}
		return found
	}
	switch {
	case code < 0x80:
		return int(code)
	case code < 0x90:
		return fields(uint64(code & 15))
	case code < 0xa0:
		return list(uint64(code & 15))
	case code < 0xc0:
		return string(raw(uint64(code & 31)))
	case code >= 0xe0:
		return int(int8(code))
	case code == 0xc0:
		return nil
	case code <= 0xc3:
		return code == 0xc3
	case code <= 0xc6:
		return raw(number(1 << (code - 0xc4)))
	case code == 0xca:
		return float64(math.Float32frombits(uint32(number(4))))
	case code == 0xcb:
		return math.Float64frombits(number(8))
	case code >= 0xcc && code <= 0xcf:
		return int(number(1 << (code - 0xcc)))
	case code >= 0xd0 && code <= 0xd3:
		return signed(1 << (code - 0xd0))
	case code >= 0xd9 && code <= 0xdb:
		return string(raw(number(1 << (code - 0xd9))))
	case code == 0xdc || code == 0xdd:
		return list(number(2 << (code - 0xdc)))
	case code == 0xde || code == 0xdf:
		return fields(number(2 << (code - 0xde)))
	}
	panic(fmt.Sprintf("no MessagePack of this protocol: byte %#x", code))
}

// ---- WebSocket (RFC 6455): one binary message is one message of the protocol ----

type socket struct {
	net.Conn
	in *bufio.Reader
}

func dial(address string) *socket {
	at := must(url.Parse(address))
	port := map[bool]string{false: "80", true: "443"}[at.Scheme == "https"]
	if at.Port() != "" {
		port = at.Port()
	}
	conn := must(net.DialTimeout("tcp", net.JoinHostPort(at.Hostname(), port), patience))
	if at.Scheme == "https" {
		conn = tls.Client(conn, &tls.Config{ServerName: at.Hostname()})
	}
	key := make([]byte, 16)
	must(rand.Read(key))
	header := "GET /v1/stream HTTP/1.1\r\nHost: " + at.Host + "\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n" +
		"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: probeless-v1\r\nSec-WebSocket-Key: " +
		base64.StdEncoding.EncodeToString(key) + "\r\n"
	if token := at.Query().Get("token"); token != "" {
		header += "Authorization: Bearer " + token + "\r\n"
	}
	must(conn.Write([]byte(header + "\r\n")))
	in := bufio.NewReader(conn)
	answer := must(http.ReadResponse(in, nil))
	if answer.StatusCode != http.StatusSwitchingProtocols || answer.Header.Get("Sec-WebSocket-Protocol") != "probeless-v1" {
		panic("what answers is no probeless server of version 1: " + answer.Status)
	}
	return &socket{conn, in}
}

// write sends one whole frame: 2 is binary, 8 is close, 10 is pong. Clients mask what they send.
func (s *socket) write(kind byte, data []byte) {
	frame := binary.BigEndian.AppendUint64([]byte{0x80 | kind, 0x80 | 127}, uint64(len(data)))
	if len(data) < 126 {
		frame = []byte{0x80 | kind, 0x80 | byte(len(data))} // RFC 6455: as short as possible
	} else if len(data) < 1<<16 {
		frame = binary.BigEndian.AppendUint16([]byte{0x80 | kind, 0x80 | 126}, uint16(len(data)))
	}
	var mask [4]byte
	must(rand.Read(mask[:]))
	frame = append(frame, mask[:]...)
	for i, b := range data {
		frame = append(frame, b^mask[i%4])
	}
	must(s.Write(frame))
}

func (s *socket) say(m message) { s.write(2, pack(nil, m)) }

// hear is the next message. A server's error and the end of the connection end this program.
func (s *socket) hear() message {
	var whole []byte
	for {
		must(0, s.SetReadDeadline(time.Now().Add(patience)))
		var head [2]byte
		must(io.ReadFull(s.in, head[:]))
		size := uint64(head[1] & 127)
		if size >= 126 {
			var wide [8]byte // the size in 2 or 8 bytes
			must(io.ReadFull(s.in, wide[(127-size)*6:]))
			size = binary.BigEndian.Uint64(wide[:])
		}
		if size > maxMessage {
			panic("a message of " + strconv.FormatUint(size, 10) + " bytes")
		}
		data := make([]byte, size)
		must(io.ReadFull(s.in, data))
		switch kind := head[0] & 15; {
		case kind == 8 && size >= 2:
			panic(fmt.Sprintf("closed with %d: %s", binary.BigEndian.Uint16(data), data[2:]))
		case kind == 8:
			panic("closed")
		case kind == 9:
			s.write(10, data)
		case kind <= 2:
			whole = append(whole, data...)
			if head[0]&0x80 != 0 {
				return unpack(bytes.NewReader(whole)).(message)
			}
		}
	}
}

// ---- the conversation ----

func frame(n int) message {
	picture, depth, pose := scene(n)
	var jpg bytes.Buffer
	must(0, jpeg.Encode(&jpg, picture, &jpeg.Options{Quality: 90}))
	return message{
		"type": "frame", "frame": n, "timestamp_s": float64(n) / 30, "world_from_camera": pose,
		"color": message{"width": width, "height": height, "codec": "jpeg", "data": jpg.Bytes()},
		"depth": message{"width": width, "height": height, "codec": "zdelta", "data": must(zdelta(depth))},
	}
}

func main() {
	if len(os.Args) < 2 {
		fmt.Fprintln(os.Stderr, "usage: go run stream.go http://HOST:PORT/?token=TOKEN [FRAMES [PICTURE]]")
		os.Exit(2)
	}
	defer func() {
		if why := recover(); why != nil {
			fmt.Fprintln(os.Stderr, "stream:", why)
			os.Exit(1)
		}
	}()
	frames := must(strconv.Atoi(append(os.Args, "10")[2]))
	server := dial(os.Args[1])
	server.say(message{
		"type": "hello", "client": "stream.go",
		"camera": message{"width": width, "height": height, "fx": focal, "fy": focal,
			"cx": (width - 1) / 2.0, "cy": (height - 1) / 2.0, "depth_scale_m": depthScale},
		"wishes": message{"preset": "reg8", "volume_m": []any{-1.5, -1.0, 0.5, 1.5, 1.0, 2.5}, "voxel_m": 0.02},
	})
	welcome := server.hear()
	if welcome["type"] != "welcome" {
		panic(fmt.Sprint("refused: ", welcome["reason"]))
	}
	fmt.Printf("%v on %v\n", welcome["server"], welcome["device"])
	cube := "v 0 0 0\nv .2 0 0\nv 0 .2 0\nv 0 0 .2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
	server.say(message{"type": "place_object", "request": 1, "object": "pyramid", "format": "obj", "data": []byte(cube),
		"position_m": []any{0.0, 0.55, 1.6}})
	var picture []byte
	for sent, answered := 0, 0; answered < frames; {
		for sent < frames && sent-answered < welcome["max_inflight"].(int) {
			server.say(frame(sent))
			sent++
		}
		switch got := server.hear(); got["type"] {
		case "light": // comes before its composite
			fmt.Printf("frame %v: light from %.3v, valid %v\n", got["frame"], got["dominant_direction"], got["valid"])
		case "composite":
			picture = got["color"].(message)["data"].([]byte)
			answered++
		case "dropped":
			fmt.Printf("frame %v was dropped: %v\n", got["frame"], got["reason"])
			answered++
		case "acknowledged":
			fmt.Printf("request %v: error %v, notes %v\n", got["request"], got["error"], got["notes"])
		case "error", "bye":
			fmt.Println(got["type"], got["reason"])
		}
	}
	server.say(message{"type": "bye"})
	server.write(8, []byte{0x03, 0xe8}) // close, 1000
	if len(os.Args) > 3 {
		must(0, os.WriteFile(os.Args[3], picture, 0o644))
	}
}

// must ends the program where a call has failed; main prints why.
func must[T any](value T, err error) T {
	if err != nil {
		panic(err)
	}
	return value
}
