/* SPDX-License-Identifier: MPL-2.0 */

#ifndef __ZMQ_INTAKE_HPP_INCLUDED__
#define __ZMQ_INTAKE_HPP_INCLUDED__

#include <atomic>
#include <memory>
#include <mutex>
#include <set>
#include <stddef.h>
#include <stdint.h>

namespace zmq
{
class session_base_t;

//  What all peers of a bound socket make it hold.
struct intake_pool_t
{
    intake_pool_t () : held (0), subscribed (0), dropped (0) {}

    //  Bytes that arrived and that the application did not take yet, and
    //  bytes that are encrypted and not sent yet.
    std::atomic<int64_t> held;
    //  Bytes of subscriptions, as intake_t::topic_cost counts them.
    std::atomic<int64_t> subscribed;

    //  Connections that were dropped because of these bounds.
    std::atomic<int64_t> dropped;

    //  Sessions whose connections could be dropped to get bytes back.
    std::mutex sync;
    std::set<session_base_t *> holders;
};

//  What one peer makes a bound socket hold. The session and the socket's end
//  of the pipe share it; what is left when both are gone went with them.
class intake_t
{
  public:
    explicit intake_t (const std::shared_ptr<intake_pool_t> &pool_) :
        _pool (pool_),
        _held (0),
        _subscribed (0)
    {
    }

    ~intake_t ()
    {
        _pool->held -= _held;
        _pool->subscribed -= _subscribed;
    }

    void hold (int64_t bytes_)
    {
        _held += bytes_;
        _pool->held += bytes_;
    }

    void subscribe (int64_t bytes_)
    {
        _subscribed += bytes_;
        _pool->subscribed += bytes_;
    }

    int64_t subscribed () const { return _subscribed; }
    intake_pool_t &pool () const { return *_pool; }

    //  What a frame takes in a pipe.
    static int64_t frame_cost (size_t size_)
    {
        return static_cast<int64_t> (size_) + 128;
    }

    //  What a subscription takes: a node of the trie for each byte, at worst.
    static int64_t topic_cost (size_t size_)
    {
        return 64 * static_cast<int64_t> (size_) + 256;
    }

  private:
    const std::shared_ptr<intake_pool_t> _pool;
    std::atomic<int64_t> _held;
    std::atomic<int64_t> _subscribed;

    intake_t (const intake_t &);
    const intake_t &operator= (const intake_t &);
};
}

#endif
